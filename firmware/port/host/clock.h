/* Absolute deadlines, one period apart. */
#ifndef HOST_CLOCK_H
#define HOST_CLOCK_H

#include <stdint.h>

struct clock {
    int64_t period_ns;
    int64_t deadline_ns;
    uint64_t late; /* deadlines that were missed by more than a period */
};

void clock_start(struct clock *clock, int64_t period_ns);

/* Waits for the next deadline, or returns at once where it is past. Returns the periods that were missed.
 *
 * A small delay is made up for, so that ticks keep their rate; after more than 20 periods they are only late, and the
 * deadlines move: a laptop that slept must not run a thousand ticks at once, among which no heartbeat can arrive. */
int64_t clock_wait(struct clock *clock);

/* Something that differs at every start. */
uint32_t clock_entropy(void);

#endif
