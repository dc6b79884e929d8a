/* A simulated device as a process of its own, hilbo-motor, and the memory that it shares with the program which closes the
 * loop: the newest sample, and the newest force command. It stands for a device's driver, and keeps the promise that a
 * real one must keep: when no new command has come for some milliseconds, the force is zero, whatever has become of the
 * program. Each field is written by one side, as one aligned word of 8 bytes. For gcc and clang. */
#ifndef HILBO_MOTOR_H
#define HILBO_MOTOR_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>

struct hilbo_motor {
    uint64_t samples; /* of the motor: how many there have been; the rest belongs to the newest */
    double position_mm;
    double velocity_mm_per_s;
    double felt_N;      /* force that is put out now; 0 where commands are too old */
    uint64_t commands;  /* of the program: one more with each force */
    double force_N;     /* positive pushes out */
};

/* The memory behind a file, which is made if `makes`; NULL with errno set where there is none. */
static inline struct hilbo_motor *hilbo_motor_open(const char *file, int makes)
{
    void *memory = MAP_FAILED;
    const int opened = open(file, makes ? O_RDWR | O_CREAT : O_RDWR, 0600);
    if (opened >= 0 && (!makes || ftruncate(opened, (off_t)sizeof(struct hilbo_motor)) == 0)) {
        memory = mmap(NULL, sizeof(struct hilbo_motor), PROT_READ | PROT_WRITE, MAP_SHARED, opened, 0);
    }
    if (opened >= 0) {
        (void)close(opened);
    }
    return memory == MAP_FAILED ? NULL : (struct hilbo_motor *)memory;
}

static inline double hilbo_motor_get(const double *field)
{
    double value;
    __atomic_load(field, &value, __ATOMIC_ACQUIRE);
    return value;
}

static inline void hilbo_motor_put(double *field, double value)
{
    __atomic_store(field, &value, __ATOMIC_RELEASE);
}

/* A force command: a new one each time, although the force may be the same. */
static inline void hilbo_motor_command(struct hilbo_motor *motor, double force_N)
{
    hilbo_motor_put(&motor->force_N, force_N);
    (void)__atomic_fetch_add(&motor->commands, 1U, __ATOMIC_RELEASE);
}

#endif
