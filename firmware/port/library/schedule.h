/* From the times of a program's calls to ticks: which call is a tick, how late it is, and how many were missed. */
#ifndef LIBRARY_SCHEDULE_H
#define LIBRARY_SCHEDULE_H

#include <stdbool.h>
#include <stdint.h>

struct schedule {
    double period_s;
    double due_s;  /* when the next tick is due */
    double last_s; /* of the last call */
    bool begun;
    uint32_t calls;    /* since the last tick */
    uint32_t settling; /* so many calls to come are all ticks, and the earliest of them says when ticks are due */
};

enum moment {
    MOMENT_TICK,
    MOMENT_EARLY, /* the next tick is not due yet */
    MOMENT_WRONG  /* no number, not after the last call, or too many calls within a period */
};

struct arrival {
    enum moment moment;
    uint32_t missed;  /* ticks before this one */
    uint32_t late_us; /* 0 where ticks were missed: the schedule begins anew */
};

/* A call at `time_s`. */
struct arrival schedule_arrive(struct schedule *schedule, double time_s);

#endif
