/* The little arithmetic that C's own operators lack. No libm: the same bits everywhere. */
#ifndef HB_MATH_H
#define HB_MATH_H

#include <stdbool.h>
#include <stdint.h>

/* base^exponent for a whole base of 1 to 65535 and 0 <= exponent <= 1, within 0.6 units in the last place. */
float hb_power(uint32_t base, float exponent);

bool hb_is_finite(float value);

float hb_absolute(float value);

/* `value`, or the nearer of the two bounds; low <= high, none of them NaN. */
float hb_clamp(float value, float low, float high);

/* `value` moved towards 0 by `step` >= 0, and no further than 0. */
float hb_towards_zero(float value, float step);

uint32_t hb_bits_of_float(float value);
float hb_float_of_bits(uint32_t bits);

#endif
