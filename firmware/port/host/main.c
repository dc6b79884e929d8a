/* hilbo-device: the device's core, with a simulated actuator and finger, on a pseudo-terminal.
 *
 * One loop does everything the core asks for: bytes in, a tick, bytes out. At 1 kHz on a laptop that has other things to
 * do a tick may be late. That is no fault of the device that is simulated, so that it runs late and is counted, and
 * only --strict passes it on as an overrun (which holds). In lockstep nothing depends on time: ticks run when
 * stdin asks for them. */
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "clock.h"
#include "line.h"
#include "options.h"
#include "rig.h"

enum { FAILED = 1, BAD_USAGE = 2, COMMAND_SIZE = 128, UNSENT_SIZE = 256, MOST_WAIT_MS = 100 };

struct process {
    struct options options;
    struct sim_rig rig;
    struct line line;
    struct clock clock;
    uint32_t boot_id;
    float force_N;
    char command[COMMAND_SIZE]; /* what has come of one */
    size_t command_size;
    uint8_t unsent[UNSENT_SIZE]; /* taken from the device, not yet by the line */
    size_t unsent_size;
    bool ended;
};

static volatile sig_atomic_t stopping;

static void on_signal(int number)
{
    (void)number;
    stopping = 1;
}

static void install_signals(void)
{
    struct sigaction action = {.sa_handler = on_signal};
    (void)sigemptyset(&action.sa_mask);
    const int ends[] = {SIGTERM, SIGINT, SIGHUP};
    for (size_t i = 0; i < sizeof ends / sizeof ends[0]; i++) {
        (void)sigaction(ends[i], &action, NULL);
    }
    action.sa_handler = SIG_IGN;
    (void)sigaction(SIGPIPE, &action, NULL);
}

/* What the line does not take stays in the device, which drops whole frames when it has no more room. */
static void transmit(struct process *process)
{
    for (;;) {
        if (process->unsent_size == 0) {
            process->unsent_size = hb_transmit(&process->rig.device, process->unsent, UNSENT_SIZE);
        }
        const size_t put =
            process->unsent_size > 0 ? line_write(&process->line, process->unsent, process->unsent_size) : 0;
        if (put == 0) {
            return;
        }
        process->unsent_size -= put;
        memmove(process->unsent, process->unsent + put, process->unsent_size);
    }
}

static void receive(struct process *process)
{
    uint8_t bytes[256];
    for (size_t size; (size = line_read(&process->line, bytes, sizeof bytes)) > 0;) {
        for (size_t taken = 0; taken < size;) {
            taken += hb_receive(&process->rig.device, bytes + taken, size - taken);
            transmit(process);
        }
    }
}

static void tick(struct process *process)
{
    process->force_N = sim_rig_tick(&process->rig);
    transmit(process);
}

static bool start_device(struct process *process)
{
    const struct options *options = &process->options;
    process->boot_id = options->boot_id != 0 ? options->boot_id : clock_entropy() | 1U;
    const enum hb_error error = sim_rig_start(&process->rig, &options->rig, process->boot_id);
    if (error != HB_OK) {
        (void)fprintf(stderr, "hilbo-device: %s\n", hb_error_sentence(error));
    }
    return error == HB_OK;
}

static void restart_device(struct process *process)
{
    process->boot_id += 2U; /* stays odd, so never 0 */
    process->unsent_size = 0;
    (void)sim_rig_restart(&process->rig, process->boot_id); /* with the config that was good at the start */
    (void)printf("restart %lu\n", (unsigned long)process->boot_id);
}

static void run_ticks(struct process *process, unsigned long count)
{
    for (unsigned long i = 0; i < count && !stopping; i++) {
        tick(process);
        receive(process);
    }
    const struct hb_device *device = &process->rig.device;
    (void)printf("tick %lu %.9g %lu\n", (unsigned long)device->tick, (double)process->force_N,
                 (unsigned long)device->heartbeat_age_ticks);
}

/* A fault of the hardware; false where the command names none. */
static bool obey_fault(struct sim_rig *rig, const char *command)
{
    unsigned long count = 0;
    if (sscanf(command, "bad %lu", &count) == 1) {
        rig->bad_ticks = (uint32_t)count;
    } else if (sscanf(command, "late %lu", &count) == 1) {
        rig->late_ticks = (uint32_t)count;
    } else if (sscanf(command, "late_us %lu", &count) == 1) {
        rig->late_us = (uint32_t)count;
    } else if (strcmp(command, "stop open") == 0) {
        rig->stop_open = true;
    } else if (strcmp(command, "stop closed") == 0) {
        rig->stop_open = false;
    } else {
        return false;
    }
    (void)printf("%s\n", command);
    return true;
}

/* One line from stdin; every command is answered by one line. */
static void obey(struct process *process, const char *command)
{
    enum sim_press press = SIM_PRESS_NONE;
    unsigned long count = 0;
    char kind[16] = "";
    if (sscanf(command, "tick %lu", &count) == 1 && process->options.lockstep) {
        run_ticks(process, count);
    } else if (strcmp(command, "restart") == 0) {
        restart_device(process);
    } else if (sscanf(command, "finger %15s", kind) == 1 && sim_press_by_name(kind, &press)) {
        sim_world_press(&process->rig.world, press);
        (void)printf("finger %s\n", kind);
    } else if (!obey_fault(&process->rig, command)) {
        (void)printf("unknown %s\n", command);
    }
    (void)fflush(stdout);
}

/* Reads what stdin has, and obeys the lines in it. Its end is the end of the process. */
static void read_commands(struct process *process)
{
    char bytes[COMMAND_SIZE];
    const ssize_t size = read(STDIN_FILENO, bytes, sizeof bytes);
    if (size == 0 || (size < 0 && errno != EINTR && errno != EAGAIN)) {
        process->ended = true;
    }
    for (ssize_t i = 0; i < size; i++) {
        if (bytes[i] == '\n') {
            process->command[process->command_size] = '\0';
            process->command_size = 0;
            obey(process, process->command);
        } else if (process->command_size + 1U < COMMAND_SIZE) {
            process->command[process->command_size++] = bytes[i];
        }
    }
}

/* What there is to read, after at most `timeout_ms`. */
static void serve(struct process *process, int timeout_ms)
{
    struct pollfd files[2] = {
        {.fd = process->line.master, .events = POLLIN},
        {.fd = process->options.control ? STDIN_FILENO : -1, .events = POLLIN},
    };
    if (poll(files, 2, timeout_ms) <= 0) {
        return;
    }
    if (files[0].revents != 0) {
        receive(process);
    }
    if (files[1].revents != 0) {
        read_commands(process);
    }
}

static void run(struct process *process)
{
    const double tick_s = process->options.rig.world.tick_s;
    clock_start(&process->clock, (int64_t)(tick_s * 1e9 + 0.5));
    while (!stopping && !process->ended) {
        if (process->options.lockstep) {
            serve(process, MOST_WAIT_MS); /* a signal just before the wait would be seen after it */
            transmit(process);
            continue;
        }
        const int64_t missed = clock_wait(&process->clock);
        if (process->options.strict && missed > 0) {
            process->rig.late_ticks = 1;
        }
        serve(process, 0);
        tick(process);
    }
}

int main(int count, char **arguments)
{
    static struct process process;
    if (!options_read(&process.options, count, arguments)) {
        return BAD_USAGE;
    }
    if (process.options.help) {
        (void)fputs(OPTIONS_HELP, stdout);
        return EXIT_SUCCESS;
    }
    install_signals();
    if (!start_device(&process)) {
        return BAD_USAGE;
    }
    if (!line_open(&process.line, process.options.link)) {
        (void)fprintf(stderr, "hilbo-device: no pseudo-terminal, or no link to it: %s.\n", strerror(errno));
        return FAILED;
    }
    (void)printf("%s\n", process.line.name);
    (void)fflush(stdout);
    run(&process);
    line_close(&process.line);
    (void)fprintf(stderr, "hilbo-device: %lu ticks, %lu late.\n", (unsigned long)process.rig.device.tick,
                  (unsigned long)process.clock.late);
    return EXIT_SUCCESS;
}
