/* The little arithmetic that C's own operators lack. No libm: the same bits everywhere. */
#ifndef HB_MATH_H
#define HB_MATH_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* base^exponent for a whole base of 1 to 65535 and 0 <= exponent <= 1, within 0.6 units in the last place. */
/*@ assigns \nothing; */
float hb_power(uint32_t base, float exponent);

/*@ assigns \nothing; */
bool hb_is_finite(float value);

/*@ assigns \nothing; */
float hb_absolute(float value);

/* Square root of a finite value >= 0, within one unit in the last place; without libm, by Newton's steps. */
/*@ assigns \nothing; */
float hb_root(float value);

/* `value`, or the nearer of the two bounds; low <= high, none of them NaN. */
/*@ assigns \nothing; */
float hb_clamp(float value, float low, float high);

/* `value` moved towards 0 by `step` >= 0, and no further than 0. */
/*@ assigns \nothing; */
float hb_towards_zero(float value, float step);

/* A product and a sum are rounded together, as by a fused multiply-add: this build gives other bits than every other. */
/*@ assigns \nothing; */
bool hb_rounds_once(void);

/*@ assigns \nothing; */
uint32_t hb_bits_of_float(float value);
/*@ assigns \nothing; */
float hb_float_of_bits(uint32_t bits);

#ifdef __cplusplus
}
#endif

#endif
