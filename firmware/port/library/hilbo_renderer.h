/* libhilbo_renderer: the core of the hilbo device for a program that closes the loop itself, at 1 kHz, on the computer.
 *
 *     const char *why;
 *     struct hilbo_renderer *renderer = hilbo_open(&numbers, &why);      the device's own numbers, measured
 *     hilbo_set(renderer, &set);                                         parameters; commits by itself when it may
 *     each period:     force_N = hilbo_tick(renderer, position_mm, velocity_mm_per_s, time_s);   and output it at once
 *     now and then:    hilbo_heartbeat(renderer);    from the thread that may end the motion; at least every 100 ms
 *     hilbo_get_state(renderer, &state);  hilbo_start(renderer, state.stops);  ...  hilbo_stop(renderer);
 *
 * The safety chain is the device's, by the same code: input check, passivity, saturation, slew limit, velocity,
 * overrun, heating, watchdog, START only out of contact. What the library cannot do: it computes a force, and the motor
 * is the program's. When hilbo_tick is no longer called (the program hangs, or is killed) the force has to end in the
 * device's driver, or in a process of its own that owns the device. docs/device/host-port.md has both, measured.
 *
 * Signs: position > 0 is penetration, 0 the surface; a positive force pushes out, towards negative positions, and a
 * rendered force is never negative.
 *
 * Threads: every function may be called from any thread, on the same renderer too, but hilbo_tick from one thread only,
 * and hilbo_close when no other call runs. Each call holds a lock for some microseconds, with priority inheritance where
 * the system has it. hilbo_estop takes no lock, and may be called in a signal handler. hilbo_tick does not allocate,
 * print or wait for anything but that lock. Nothing is global: a program may have several renderers. */
#ifndef HILBO_RENDERER_H
#define HILBO_RENDERER_H

#include <stddef.h>
#include <stdint.h>

#if defined(_WIN32) && defined(HILBO_BUILDS_LIBRARY)
#define HILBO_API __declspec(dllexport)
#elif defined(_WIN32)
#define HILBO_API __declspec(dllimport)
#else
#define HILBO_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

enum { HILBO_MOST_EXPONENTIALS = 12 };

struct hilbo_renderer; /* opaque */

struct hilbo_range {
    double low;
    double high;
};

/* What the device is. Measure, do not copy; docs/device/firmware.md says how each number is chosen. */
struct hilbo_device_numbers {
    uint32_t size;                  /* sizeof(struct hilbo_device_numbers), so that program and library mean the same */
    uint32_t simulated;             /* 1: no person touches it; only then may delay_us be 0 */
    uint32_t passivity_controller;  /* 1: on */
    uint32_t tick_rate_Hz;          /* of the program's loop, 100 to 10000 */
    uint32_t latency_us;            /* from when a position is sampled until its force is out, measured, the largest */
    uint32_t delay_us;              /* the same from when the tick is due: latency and the lateness that is tolerated.
                                     * Sets are checked for it, a later tick is a HOLD; at most one period */
    uint32_t watchdog_ticks;        /* without hilbo_heartbeat: HOLD; at most 1 s */
    uint32_t hold_ticks;            /* HOLD and STOP reach zero force within this; at most 0.1 s */
    double damping_N_s_per_m;       /* physical damping b along the motion, the lower end of its interval */
    double force_limit_N;           /* at most 100 N */
    double continuous_force_N;      /* root mean square over about heating_s that the motor bears */
    double heating_s;               /* 0.1 to 1000 s */
    double position_low_mm;         /* a position outside of these two is bad input; at most 32767 steps either way */
    double position_high_mm;
    double position_step_mm;        /* positions are rounded to it: the device's resolution; at most 0.1 mm */
    double slew_limit_N_per_s;      /* of a rising force */
    double velocity_limit_mm_per_s; /* faster: HOLD */
    double plausible_step_mm;       /* more than this in one tick is bad input */
    struct hilbo_range K0_N_per_mm; /* parameters outside of these ranges are refused */
    struct hilbo_range K1_N_per_mm;
    struct hilbo_range B1_N_s_alpha_per_mm;
    struct hilbo_range alpha;
};

/* One parameter set, with short memory (`taps` past samples, odd, at most 255) or with full memory (`exponentials`). */
struct hilbo_parameters {
    double K0_N_per_mm;
    double K1_N_per_mm;
    double B1_N_s_alpha_per_mm;
    double alpha;
    double force_limit_N;
    uint32_t taps;         /* 0 with full memory */
    uint32_t exponentials; /* 0 with short memory; those of hilbo.mechanics.exponentials, fastest first */
    double weight[HILBO_MOST_EXPONENTIALS];
    double loss[HILBO_MOST_EXPONENTIALS];
};

/* As in firmware/PROTOCOL.md. */
enum hilbo_state_name {
    HILBO_STOPPED = 0,
    HILBO_RUNNING = 1,
    HILBO_STOPPING = 2,
    HILBO_HOLD = 4,
    HILBO_ESTOP = 5
};

/* Why it is in its state: hold_reason of firmware/PROTOCOL.md, and one more. */
enum hilbo_cause {
    HILBO_CAUSE_NONE = 0,
    HILBO_CAUSE_WATCHDOG = 1,
    HILBO_CAUSE_INPUT = 2,
    HILBO_CAUSE_VELOCITY = 3,
    HILBO_CAUSE_OVERRUN = 4,
    HILBO_CAUSE_MODEL = 5,
    HILBO_CAUSE_ESTOP = 7,
    HILBO_CAUSE_BOOT = 8,
    HILBO_CAUSE_HEAT = 10,
    HILBO_CAUSE_CLOCK = 100 /* time_s was no number or did not rise, or hilbo_tick was called much too often */
};

/* What became of the set that hilbo_set was given last. */
enum hilbo_fate { HILBO_NO_SET = 0, HILBO_WAITING = 1, HILBO_IN_FORCE = 2, HILBO_REFUSED = 3 };

struct hilbo_state {
    uint32_t state; /* enum hilbo_state_name */
    uint32_t cause; /* enum hilbo_cause */
    uint32_t stops; /* how many stops there have been; hilbo_start and hilbo_clear name the last one */
    uint32_t set;   /* enum hilbo_fate */
    uint32_t wait_ticks; /* while the set waits: at most so many until it may be committed, fewer out of contact */
    uint32_t contact;    /* 1: in the material */
    uint32_t ticks;      /* of the core */
    uint32_t missed;     /* periods in which hilbo_tick was not called */
    uint32_t early;      /* calls before the next tick was due, which were answered with the force of the last */
    uint32_t late_us;    /* how late the last tick came */
    uint32_t latest_us;  /* and the latest of all that missed no period */
    double time_s;       /* of the last call of hilbo_tick */
    double position_mm;  /* that is believed */
    double force_N;      /* of the last tick */
    double minimum_damping_N_s_per_m; /* that the set in force needs */
    uint32_t input_held; /* how often each safeguard has acted */
    uint32_t saturated;
    uint32_t slewed;
    uint32_t controlled;
    uint32_t holds;
    uint32_t estops;
    uint32_t overruns;
};

/* A renderer, STOPPED and without a set; NULL with a sentence in *why (a constant, never NULL) if a number is out of its
 * range. `why` may be NULL. */
HILBO_API struct hilbo_renderer *hilbo_open(const struct hilbo_device_numbers *numbers, const char **why);

HILBO_API void hilbo_close(struct hilbo_renderer *renderer); /* NULL is nothing to close */

/* Check a set and stage it: 0, or the number of the refusal (NACK reason of firmware/PROTOCOL.md). Its history begins to
 * run, and it is put in force at the first tick that may, which is at once out of contact unless the device has a delay;
 * then hilbo_state has HILBO_IN_FORCE. A set that turns out not to be passive with the delay has HILBO_REFUSED. */
HILBO_API int hilbo_set(struct hilbo_renderer *renderer, const struct hilbo_parameters *set);

/* Render the newest set, which must be in force, from out of contact: 0, or the number of the refusal. `stops` is that
 * of the hilbo_state which the caller has looked at: after a later stop the order does nothing and is refused. */
HILBO_API int hilbo_start(struct hilbo_renderer *renderer, uint32_t stops);

/* HOLD or ESTOP -> STOPPED, once the force is zero; `stops` as above. */
HILBO_API int hilbo_clear(struct hilbo_renderer *renderer, uint32_t stops);

/* Force to zero within hold_ticks, then STOPPED. */
HILBO_API void hilbo_stop(struct hilbo_renderer *renderer);

/* Force zero at the next call of hilbo_tick, latched. */
HILBO_API void hilbo_estop(struct hilbo_renderer *renderer);

/* The thread that gives the orders is alive. Without it for watchdog_ticks: HOLD. */
HILBO_API void hilbo_heartbeat(struct hilbo_renderer *renderer);

/* One period: the force (N) to output until the next call; finite, and at most force_limit_N. position_mm: NaN where the
 * device gave none. velocity_mm_per_s: NaN where the device gives none; the faster of this and of the positions counts.
 * time_s: when the position was sampled, by one clock that only rises.
 *
 * The calls need not be even: a call earlier than a quarter period before its tick is due is answered with the force of
 * the last tick, so that a loop may run faster than tick_rate_Hz; a tick that is later than delay_us is a HOLD; for
 * each period without a call the core gets a missed tick, so that after hold_ticks of silence the first force is 0. The
 * schedule begins with the earliest of 20 calls, after a gap too, and follows a loop that is up to 0.2 % faster or
 * 0.05 % slower. A time that is no number, or is not after that of the call before: no force, and ESTOP. */
HILBO_API double hilbo_tick(struct hilbo_renderer *renderer, double position_mm, double velocity_mm_per_s,
                            double time_s);

HILBO_API void hilbo_get_state(struct hilbo_renderer *renderer, struct hilbo_state *state);

/* What was refused last, and why, in a sentence with its numbers; "" if nothing was. Cut to `room` bytes with their 0. */
HILBO_API void hilbo_sentence(struct hilbo_renderer *renderer, char *text, size_t room);

/* Why a renderer is in HOLD or ESTOP, in words. A constant. */
HILBO_API const char *hilbo_cause_in_words(uint32_t cause);

/* K0 (N/mm) with which a set of `taps` past samples has the static stiffness K_eff; the K0 of `set` is not read. With
 * exponentials K0 is K_eff. */
HILBO_API double hilbo_K0_of(const struct hilbo_parameters *set, uint32_t tick_rate_Hz, double K_eff_N_per_mm);

/* Along a surface's normal, a unit vector out of the material. A flat surface, or one whose normal hardly turns within a
 * touch: passivity is known along one direction. */
static inline double hilbo_penetration_mm(const double position_mm[3], const double surface_mm[3],
                                          const double normal[3])
{
    return (surface_mm[0] - position_mm[0]) * normal[0] + (surface_mm[1] - position_mm[1]) * normal[1] +
           (surface_mm[2] - position_mm[2]) * normal[2];
}

/* The velocity into the material, for hilbo_tick. */
static inline double hilbo_speed_mm_per_s(const double velocity_mm_per_s[3], const double normal[3])
{
    return -(velocity_mm_per_s[0] * normal[0] + velocity_mm_per_s[1] * normal[1] + velocity_mm_per_s[2] * normal[2]);
}

static inline void hilbo_force_vector(double force_N, const double normal[3], double vector_N[3])
{
    for (int axis = 0; axis < 3; axis++) {
        vector_N[axis] = force_N * normal[axis];
    }
}

#ifdef __cplusplus
}
#endif

#endif
