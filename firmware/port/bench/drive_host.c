/* hilbo-drive: a program of its own that closes the loop at 1 kHz with libhilbo_renderer and hilbo-motor, and fails on
 * purpose: ticks that come 3 ms late, missed seconds, and at the end it kills itself.
 *
 *     hilbo-drive MOTOR LOG SECONDS [K0 K1 B1 ALPHA]
 *
 * stdout has a line for each fault: its kind, and when the last force before it was output (CLOCK_MONOTONIC, ns). LOG
 * has one line for each order and each tick, from which a test repeats the run on the device's core. */
#include <inttypes.h>
#include <math.h>
#include <signal.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "clock.h"
#include "hilbo_motor.h"
#include "hilbo_realtime.h"
#include "hilbo_renderer.h"

enum { FAILED = 1, BAD_USAGE = 2, PERIOD_NS = 1000000, BEAT_TICKS = 50, APART_TICKS = 500, MOST_LINES = 400000 };

enum line_kind { LINE_TICK, LINE_SET, LINE_START, LINE_CLEAR, LINE_STOP, LINE_BEAT };

struct line {
    enum line_kind kind;
    double time_s;
    double position_mm;
    double force_N;
    uint32_t missed;
    uint32_t early; /* 1: answered with the force of the last tick */
    uint32_t late_us;
    uint32_t state;
    uint32_t fate;
};

struct drive {
    struct hilbo_renderer *renderer;
    struct hilbo_motor *motor;
    struct hilbo_state state;
    struct line *lines;
    size_t size;
    uint32_t missed;        /* that the log has */
    uint32_t early;
    uint32_t running_ticks; /* with force, since the last fault */
    int64_t tick_ns;        /* of the last tick */
};

static const struct hilbo_device_numbers NUMBERS = {
    .size = sizeof(struct hilbo_device_numbers),
    .simulated = 1,
    .tick_rate_Hz = 1000,
    .latency_us = 50,
    .delay_us = 1000,
    .watchdog_ticks = 250,
    .hold_ticks = 10,
    .damping_N_s_per_m = 0.95,
    .force_limit_N = 20.0,
    .continuous_force_N = 20.0,
    .heating_s = 10.0,
    .position_low_mm = -5.1,
    .position_high_mm = 20.1,
    .position_step_mm = 0.001,
    .slew_limit_N_per_s = 500.0,
    .velocity_limit_mm_per_s = 1000.0,
    .plausible_step_mm = 2.0,
    .K0_N_per_mm = {-64.0, 64.0},
    .K1_N_per_mm = {1e-3, 64.0},
    .B1_N_s_alpha_per_mm = {1e-4, 64.0},
    .alpha = {0.005, 0.995},
};

static int64_t now_ns(void)
{
    struct timespec now = {0};
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + (int64_t)now.tv_nsec;
}

static void note(struct drive *drive, const struct line *line)
{
    if (drive->size < MOST_LINES) {
        drive->lines[drive->size++] = *line;
    }
}

static void order(struct drive *drive, enum line_kind kind)
{
    note(drive, &(struct line){.kind = kind});
}

static void tick(struct drive *drive)
{
    drive->tick_ns = now_ns();
    const double time_s = 1e-9 * (double)drive->tick_ns;
    const double position_mm = hilbo_motor_get(&drive->motor->position_mm);
    const double velocity_mm_per_s = hilbo_motor_get(&drive->motor->velocity_mm_per_s);
    const double force_N = hilbo_tick(drive->renderer, position_mm, velocity_mm_per_s, time_s);
    hilbo_motor_command(drive->motor, force_N);
    hilbo_get_state(drive->renderer, &drive->state);
    note(drive, &(struct line){LINE_TICK, time_s, position_mm, force_N, drive->state.missed - drive->missed,
                               drive->state.early - drive->early, drive->state.late_us, drive->state.state, drive->state.set});
    drive->missed = drive->state.missed;
    drive->early = drive->state.early;
    const bool pushes = drive->state.state == (uint32_t)HILBO_RUNNING && force_N > 0.5;
    drive->running_ticks = pushes ? drive->running_ticks + 1U : drive->running_ticks;
}

/* Back to rendering, as soon as that is allowed. */
static void recover(struct drive *drive)
{
    const struct hilbo_state *state = &drive->state;
    const bool stopped = state->state == (uint32_t)HILBO_STOPPED;
    const bool holds = state->state == (uint32_t)HILBO_HOLD;
    if (stopped && state->contact == 0U && state->set == (uint32_t)HILBO_IN_FORCE) {
        if (hilbo_start(drive->renderer, state->stops) == 0) {
            order(drive, LINE_START);
        }
    } else if (holds && hilbo_clear(drive->renderer, state->stops) == 0) {
        order(drive, LINE_CLEAR);
    }
}

static void sleep_ns(int64_t ns)
{
    const struct timespec time = {(time_t)(ns / 1000000000), (long)(ns % 1000000000)};
    (void)nanosleep(&time, NULL);
}

static void tell(const char *fault, int64_t since_ns)
{
    (void)printf("%s %" PRId64 "\n", fault, since_ns);
    (void)fflush(stdout);
}

/* In contact, now and then: late ticks and missed seconds in turn. */
static void fail(struct drive *drive, struct clock *clock, unsigned *faults)
{
    if (drive->running_ticks < APART_TICKS) {
        return;
    }
    const bool is_long = *faults % 2U == 1U;
    tell(is_long ? "stall" : "jitter", drive->tick_ns);
    sleep_ns(is_long ? INT64_C(1000000000) : 4 * PERIOD_NS);
    clock_start(clock, PERIOD_NS);
    *faults += 1U;
    drive->running_ticks = 0;
}

static void run(struct drive *drive, double seconds, bool fails)
{
    struct clock clock;
    unsigned faults = 0;
    clock_start(&clock, PERIOD_NS);
    const int64_t end_ns = now_ns() + (int64_t)(1e9 * seconds);
    for (uint32_t count = 0; now_ns() < end_ns; count++) {
        (void)clock_wait(&clock);
        if (count % BEAT_TICKS == 0U) {
            hilbo_heartbeat(drive->renderer);
            order(drive, LINE_BEAT);
        }
        tick(drive);
        recover(drive);
        if (fails) {
            fail(drive, &clock, &faults);
        } else if (drive->running_ticks > 200U && drive->state.force_N > 0.5) {
            tell("kill", drive->tick_ns);
            (void)raise(SIGKILL);
        }
    }
}

static bool write_log(const struct drive *drive, const char *name)
{
    static const char *const kinds[] = {"tick", "set", "start", "clear", "stop", "beat"};
    FILE *file = fopen(name, "w");
    for (size_t i = 0; file != NULL && i < drive->size; i++) {
        const struct line *line = &drive->lines[i];
        (void)fprintf(file, "%s %.17g %.17g %.9g %lu %lu %lu %lu %lu\n", kinds[line->kind], line->time_s, line->position_mm,
                      line->force_N, (unsigned long)line->missed, (unsigned long)line->early,
                      (unsigned long)line->late_us, (unsigned long)line->state, (unsigned long)line->fate);
    }
    return file != NULL && fclose(file) == 0;
}

static bool begin(struct drive *drive, const struct hilbo_parameters *set, const char *motor)
{
    char sentence[256] = "";
    const char *why = "";
    drive->lines = malloc(MOST_LINES * sizeof *drive->lines);
    drive->motor = hilbo_motor_open(motor, 0);
    drive->renderer = hilbo_open(&NUMBERS, &why);
    if (drive->lines == NULL || drive->motor == NULL || drive->renderer == NULL) {
        (void)fprintf(stderr, "hilbo-drive: %s\n", drive->renderer == NULL ? why : "no memory, or no motor there");
        return false;
    }
    if (hilbo_set(drive->renderer, set) != 0) {
        hilbo_sentence(drive->renderer, sentence, sizeof sentence);
        (void)fprintf(stderr, "hilbo-drive: %s\n", sentence);
        return false;
    }
    order(drive, LINE_SET);
    return true;
}

int main(int count, char **words)
{
    static struct drive drive;
    const bool given = count == 8;
    const struct hilbo_parameters set = {
        .K0_N_per_mm = given ? atof(words[4]) : 0.1,
        .K1_N_per_mm = given ? atof(words[5]) : 0.6,
        .B1_N_s_alpha_per_mm = given ? atof(words[6]) : 0.5,
        .alpha = given ? atof(words[7]) : 0.3,
        .force_limit_N = 15.0,
        .taps = 101,
    };
    if (count != 4 && !given) {
        (void)fprintf(stderr, "usage: hilbo-drive MOTOR LOG SECONDS [K0 K1 B1 ALPHA]\n");
        return BAD_USAGE;
    }
    if (!begin(&drive, &set, words[1])) {
        return FAILED;
    }
    if (!hilbo_realtime()) {
        (void)fprintf(stderr, "hilbo-drive: no real-time priority; ticks may be late.\n");
    }
    run(&drive, atof(words[3]), true);
    hilbo_stop(drive.renderer);
    if (!write_log(&drive, words[2])) {
        perror("hilbo-drive");
        return FAILED;
    }
    drive.running_ticks = 0;
    hilbo_close(drive.renderer);
    if (!begin(&drive, &set, words[1])) {
        return FAILED;
    }
    run(&drive, 60.0, false);
    (void)fprintf(stderr, "hilbo-drive: nothing touched the motor for a minute.\n");
    return FAILED;
}
