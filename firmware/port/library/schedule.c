#include "schedule.h"

#include <math.h>

static const double EARLIEST = 0.25;    /* periods before a tick is due at which a call counts as that tick */
static const double FORWARDS = 2e-3;    /* of a period by which the schedule moves towards an early tick */
static const double BACKWARDS = 5e-4;   /* and towards a late one: clocks differ by less */
static const double ROUNDING = 1e-6;    /* of a period */
static const double MOST_MISSED = 1e9;
enum { SETTLING_CALLS = 20 };
enum { MOST_CALLS = 100 };              /* within a period */

/* The schedule lies where the early ticks are, so that lateness is measured from there; it follows a program whose clock
 * is not the motor's, and no loop whose rate is another one. */
static void move_on(struct schedule *schedule, double late_s)
{
    const double period_s = schedule->period_s;
    double shift_s = fmin(fmax(late_s, -FORWARDS * period_s), BACKWARDS * period_s);
    if (schedule->settling > 0U) {
        schedule->settling -= 1U;
        shift_s = fmin(late_s, 0.0);
    }
    schedule->due_s += period_s + shift_s;
}

/* The call that begins may itself be a late one: the next ones tell. Nothing is rendered then, a gap being a HOLD. */
static void begin(struct schedule *schedule, double time_s)
{
    schedule->begun = true;
    schedule->due_s = time_s + schedule->period_s;
    schedule->settling = SETTLING_CALLS;
}

struct arrival schedule_arrive(struct schedule *schedule, double time_s)
{
    struct arrival arrival = {MOMENT_TICK, 0, 0};
    const bool wrong = !isfinite(time_s) || (schedule->begun && time_s <= schedule->last_s);
    schedule->calls += 1U;
    if (wrong || schedule->calls > MOST_CALLS) {
        schedule->begun = false; /* the next call begins a schedule, by whatever clock */
        schedule->calls = 0;
        arrival.moment = MOMENT_WRONG;
        return arrival;
    }
    const double late_s = schedule->begun ? time_s - schedule->due_s : 0.0;
    schedule->last_s = time_s;
    if (late_s < -EARLIEST * schedule->period_s && schedule->settling == 0U) {
        arrival.moment = MOMENT_EARLY;
        return arrival;
    }
    schedule->calls = 0;
    const double missed = floor(late_s / schedule->period_s + ROUNDING);
    if (!schedule->begun) {
        begin(schedule, time_s);
    } else if (missed >= 1.0) {
        arrival.missed = (uint32_t)fmin(missed, MOST_MISSED);
        begin(schedule, time_s);
    } else {
        arrival.late_us = (uint32_t)lround(1e6 * fmax(late_s, 0.0));
        move_on(schedule, late_s);
    }
    return arrival;
}
