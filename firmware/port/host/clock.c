#include "clock.h"

#include <time.h>
#include <unistd.h>

enum { MOST_TO_CATCH_UP = 20 };

static const int64_t NS_PER_S = 1000000000;

static int64_t now_ns(void)
{
    struct timespec now = {0};
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + (int64_t)now.tv_nsec;
}

static void sleep_until(int64_t deadline_ns)
{
#if defined(__APPLE__) /* has no clock_nanosleep */
    const int64_t left_ns = deadline_ns - now_ns();
    if (left_ns > 0) {
        const struct timespec left = {(time_t)(left_ns / NS_PER_S), (long)(left_ns % NS_PER_S)};
        (void)nanosleep(&left, NULL);
    }
#else
    const struct timespec deadline = {(time_t)(deadline_ns / NS_PER_S), (long)(deadline_ns % NS_PER_S)};
    (void)clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &deadline, NULL); /* a signal may end it early */
#endif
}

void clock_start(struct clock *clock, int64_t period_ns)
{
    *clock = (struct clock){.period_ns = period_ns, .deadline_ns = now_ns()};
}

int64_t clock_wait(struct clock *clock)
{
    clock->deadline_ns += clock->period_ns;
    if (now_ns() < clock->deadline_ns) {
        sleep_until(clock->deadline_ns);
    }
    const int64_t awake_ns = now_ns(); /* which may be long after the deadline: sleep is at least as long as asked for */
    const int64_t missed = (awake_ns - clock->deadline_ns) / clock->period_ns;
    clock->late += missed > 0 ? 1U : 0U;
    if (missed > MOST_TO_CATCH_UP) {
        clock->deadline_ns = awake_ns;
    }
    return missed;
}

uint32_t clock_entropy(void)
{
    struct timespec now = {0};
    (void)clock_gettime(CLOCK_REALTIME, &now);
    uint64_t mixed = (uint64_t)now.tv_sec * UINT64_C(0x9E3779B97F4A7C15) + (uint64_t)now.tv_nsec;
    mixed = (mixed ^ (uint64_t)getpid()) * UINT64_C(0xBF58476D1CE4E5B9);
    return (uint32_t)(mixed >> 32);
}
