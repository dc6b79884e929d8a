/* What a loop at 1 kHz needs of the system, where it gives it. */
#ifndef HILBO_REALTIME_H
#define HILBO_REALTIME_H

#include <pthread.h>
#include <sched.h>
#include <stdbool.h>

/* This thread before all that are not of real time: root, or an rtprio in limits.conf. False where it may not. */
static inline bool hilbo_realtime(void)
{
    struct sched_param param;
    param.sched_priority = 10;
    return pthread_setschedparam(pthread_self(), SCHED_FIFO, &param) == 0;
}

#endif
