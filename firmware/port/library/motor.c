/* hilbo-motor: a simulated device (mass, damping, friction, finger) as a process of its own. See hilbo_motor.h.
 *
 *     hilbo-motor FILE [FINGER [SILENCE_MS [RECORD]]]
 *
 * FILE is the shared memory, FINGER none, rest, ramp, hold, sine, tap or all, SILENCE_MS after which the force is zero
 * (15). RECORD gets a line for each tick: time (CLOCK_MONOTONIC, ns), force (N), position (mm). It prints "ready", and
 * ends by a signal, or with a pipe at its stdin. */
#include <math.h>
#include <poll.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <time.h>

#include "clock.h"
#include "hilbo_motor.h"
#include "hilbo_realtime.h"
#include "world.h"

enum { BAD_USAGE = 2, RATE_HZ = 1000, MOST_RECORDED = 1000 * 1000 };

struct record {
    int64_t time_ns;
    double force_N;
    double position_mm;
};

struct driver {
    struct hilbo_motor *shared;
    struct sim_world world;
    int64_t silence_ns;
    uint64_t commands; /* that have been seen */
    int64_t heard_ns;
    struct record *records;
    size_t recorded;
};

static int64_t now_ns(void)
{
    struct timespec now = {0};
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + (int64_t)now.tv_nsec;
}

/* The newest command, while it is young enough, and a number. */
static double commanded_N(struct driver *driver, int64_t time_ns)
{
    const uint64_t commands = __atomic_load_n(&driver->shared->commands, __ATOMIC_ACQUIRE);
    if (commands != driver->commands) {
        driver->commands = commands;
        driver->heard_ns = time_ns;
    }
    const double force_N = hilbo_motor_get(&driver->shared->force_N);
    return time_ns - driver->heard_ns < driver->silence_ns && isfinite(force_N) ? force_N : 0.0;
}

static void tick(struct driver *driver)
{
    struct hilbo_motor *shared = driver->shared;
    const int64_t time_ns = now_ns();
    const double force_N = commanded_N(driver, time_ns);
    sim_world_tick(&driver->world, -force_N);
    hilbo_motor_put(&shared->position_mm, driver->world.position_mm);
    hilbo_motor_put(&shared->velocity_mm_per_s, driver->world.velocity_mm_per_s);
    hilbo_motor_put(&shared->felt_N, force_N);
    (void)__atomic_fetch_add(&shared->samples, 1U, __ATOMIC_RELEASE);
    if (driver->records != NULL && driver->recorded < MOST_RECORDED) {
        driver->records[driver->recorded++] = (struct record){time_ns, force_N, driver->world.position_mm};
    }
}

/* The end of a pipe at stdin is the end of the process; what stands in it means nothing. */
static bool is_over(void)
{
    struct pollfd in = {.fd = STDIN_FILENO, .events = POLLIN};
    struct stat kind;
    char bytes[64];
    return fstat(STDIN_FILENO, &kind) == 0 && S_ISFIFO(kind.st_mode) && poll(&in, 1, 0) > 0 &&
           read(STDIN_FILENO, bytes, sizeof bytes) <= 0;
}

static void write_records(const struct driver *driver, const char *name)
{
    FILE *file = fopen(name, "w");
    for (size_t i = 0; file != NULL && i < driver->recorded; i++) {
        const struct record *record = &driver->records[i];
        (void)fprintf(file, "%lld %.9g %.9g\n", (long long)record->time_ns, record->force_N, record->position_mm);
    }
    if (file != NULL) {
        (void)fclose(file);
    }
}

int main(int count, char **words)
{
    static struct driver driver;
    struct sim_world_config config = sim_world_defaults();
    const double silence_ms = count > 3 ? atof(words[3]) : 15.0;
    if (count < 2 || (count > 2 && !sim_press_by_name(words[2], &config.finger.press)) || !(silence_ms > 0.0)) {
        (void)fprintf(stderr, "usage: hilbo-motor FILE [none|rest|ramp|hold|sine|tap|all [SILENCE_MS [RECORD]]]\n");
        return BAD_USAGE;
    }
    driver.shared = hilbo_motor_open(words[1], 1);
    driver.records = count > 4 ? malloc(MOST_RECORDED * sizeof *driver.records) : NULL;
    if (driver.shared == NULL || (count > 4 && driver.records == NULL)) {
        perror("hilbo-motor");
        return EXIT_FAILURE;
    }
    driver.silence_ns = (int64_t)(1e6 * silence_ms);
    driver.commands = __atomic_load_n(&driver.shared->commands, __ATOMIC_ACQUIRE);
    driver.heard_ns = now_ns() - driver.silence_ns; /* no command has come yet */
    sim_world_start(&driver.world, &config);
    tick(&driver);
    (void)printf("ready\n");
    (void)fflush(stdout);
    (void)hilbo_realtime();
    struct clock clock;
    clock_start(&clock, 1000000000 / RATE_HZ);
    while (!is_over()) {
        (void)clock_wait(&clock);
        tick(&driver);
    }
    if (count > 4) {
        write_records(&driver, words[4]);
    }
    return EXIT_SUCCESS;
}
