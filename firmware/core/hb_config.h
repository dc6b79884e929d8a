/* What a device is: the numbers that its maker measured, and the largest things this build can hold.
 *
 * Signs, everywhere: position > 0 is penetration, 0 the surface, and a positive force pushes the handle out, towards
 * negative positions. Units are in the names. The tick is the only clock. */
#ifndef HB_CONFIG_H
#define HB_CONFIG_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "build without -ffast-math: the checks against NaN and infinity are compiled away with it"
#endif

/* Compile-time maxima: they alone fix the size of struct hb_device. */
#ifndef HB_MAX_TAPS
#define HB_MAX_TAPS 255U /* past samples of short memory, odd */
#endif
#ifndef HB_MAX_STATES
#define HB_MAX_STATES 12U /* exponentials of full memory */
#endif
#ifndef HB_OUTPUT_BYTES
#define HB_OUTPUT_BYTES 512U /* frames that wait for the line */
#endif
#define HB_MAX_WARM_TICKS 5000U    /* a staged history counts as warm after at most this */
#define HB_MAX_DRIVE_TICKS 120000U /* longest DRIVE, and longest period in one */

enum hb_capability {
    HB_CAN_DRIVE = 1,
    HB_CAN_SENSE_FORCE = 2,
    HB_CAN_CONTROL_PASSIVITY = 4, /* the passivity controller is on */
    HB_IS_SIMULATED = 8,
    HB_IS_HOMED_AT_BOOT = 16 /* its encoder is absolute; any other device waits for HOME */
};

struct hb_range {
    float low;
    float high;
};

/* Constant while the device runs, and owned by the caller, who keeps it alive. Checked by hb_init. */
struct hb_config {
    uint32_t firmware;       /* hash of the build, told in HELLO */
    uint32_t line_rate_baud; /* what the line carries; decides which STREAM fits */
    uint16_t tick_rate_Hz;   /* 100 to 10000 */
    uint16_t watchdog_ticks; /* without a fresh round trip: HOLD; at most 1 s */
    uint16_t hold_ticks;     /* HOLD and STOP reach zero force within this; at most 0.1 s */
    uint16_t most_taps;      /* <= HB_MAX_TAPS */
    uint8_t most_states;     /* <= HB_MAX_STATES */
    uint8_t capabilities;    /* of enum hb_capability */
    uint32_t delay_us;       /* longest time from when a tick is due until its force is out; at most one period.
                              * Sets are checked for it, a tick that takes longer is an overrun. 0: only if simulated */

    float damping_N_s_per_m;       /* physical damping b, measured: passivity is checked with it */
    float force_limit_N;           /* largest force command, either sign; at most 100 N */
    float continuous_force_N;      /* root mean square over about heating_s that the motor bears: more is a HOLD */
    float heating_s;               /* time constant of the motor's heating, 0.1 to 1000 s */
    float position_low_mm;         /* stroke; a position outside is bad input */
    float position_high_mm;        /* at most 32767 encoder steps either way */
    float encoder_step_mm;         /* position of one count */
    float slew_limit_N_per_s;      /* largest rise of the force command, in DRIVE largest change; >= force limit per s */
    float velocity_limit_mm_per_s; /* faster: HOLD; at least one encoder step a tick */
    float plausible_step_mm;       /* more than this in one tick is bad input; above velocity_limit / tick_rate */

    struct hb_range K0_N_per_mm; /* parameters outside are refused */
    struct hb_range K1_N_per_mm; /* low > 0 */
    struct hb_range B1_N_s_alpha_per_mm; /* low > 0 */
    struct hb_range alpha;               /* within [2^-10, 1 - 2^-10] */

    /* The servo of DRIVE mode 1; not read without HB_CAN_DRIVE. The reference moves no faster than the speed, so that a
     * step does not run into the velocity limit. */
    float servo_stiffness_N_per_mm;
    float servo_damping_N_s_per_mm;
    float servo_integral_N_per_mm_s;
    float servo_speed_mm_per_s; /* > 0, below velocity_limit */
};

/* What hb_init can have against a config. */
enum hb_error {
    HB_OK = 0,
    HB_ERROR_TICKS,
    HB_ERROR_MAXIMA,
    HB_ERROR_CAPABILITIES,
    HB_ERROR_LINE,
    HB_ERROR_LIMITS,
    HB_ERROR_STROKE,
    HB_ERROR_STEP,
    HB_ERROR_PARAMETERS,
    HB_ERROR_SERVO,
    HB_ERROR_DELAY,
    HB_ERROR_HEATING,
    HB_ERROR_BOOT_ID, /* of hb_init, not of a config */
    HB_ERROR_CONTRACTION, /* of the build */
    HB_ERRORS /* how many there are */
};

/* One sentence: what is wrong, and what to write. Never NULL. */
const char *hb_error_sentence(enum hb_error error);

/* HB_OK, or the first fault in the order of the enum; `config` is not NULL. */
enum hb_error hb_config_check(const struct hb_config *config);

#ifdef __cplusplus
}
#endif

#endif
