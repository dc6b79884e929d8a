#include "hb_math.h"

#include <float.h>
#include <string.h>

/* The same bits everywhere need float arithmetic in float, and no other format for it (16: half precision apart). */
_Static_assert(FLT_EVAL_METHOD == 0 || FLT_EVAL_METHOD == 16, "float expressions must be evaluated in float");
_Static_assert(FLT_MANT_DIG == 24 && FLT_MAX_EXP == 128 && sizeof(float) == 4, "float must be IEEE 754 binary32");

#define ONE_Q28 (UINT32_C(1) << 28)
#define ONE_Q30 (UINT32_C(1) << 30)
#define LN2_Q32 UINT64_C(2977044472) /* log(2) 2^32 */

/* log2 of 1 to 65535, in units of 2^-28, rounded down, at most 2 units too low. Each squaring of the mantissa brings
 * out one more binary digit; what the squarings round off weighs less than 2^-30 in all. */
static uint32_t log2_q28(uint32_t base)
{
    uint32_t whole = 0U;
    while (base >> (whole + 1U) != 0U) {
        whole += 1U;
    }
    uint64_t mantissa = (uint64_t)base << (31U - whole); /* in [1, 2), units of 2^-31 */
    uint32_t digits = 0U;
    for (uint32_t i = 0U; i < 28U; i += 1U) {
        mantissa = (mantissa * mantissa) >> 31;
        digits <<= 1;
        if (mantissa >> 32 != 0U) {
            mantissa >>= 1;
            digits |= 1U;
        }
    }
    return whole * ONE_Q28 + digits;
}

/* 2^fraction for a fraction in units of 2^-32, in units of 2^-30: Taylor's series to the 11th power, whose rest is
 * below 2^-34; Horner's form, innermost first, rounds off less than 2 units. */
static uint32_t exp2_q30(uint32_t fraction)
{
    uint64_t exponent = ((uint64_t)fraction * LN2_Q32) >> 32;
    uint64_t sum = ONE_Q30;
    for (uint32_t i = 11U; i > 0U; i -= 1U) {
        sum = ONE_Q30 + ((exponent * sum) >> 32) / i;
    }
    return (uint32_t)sum;
}

float hb_power(uint32_t base, float exponent)
{
    uint64_t exponent_q32 = (uint64_t)(exponent * 4294967296.0F);
    uint64_t log2_q60 = exponent_q32 * log2_q28(base);
    uint32_t whole = (uint32_t)(log2_q60 >> 60);
    uint32_t mantissa = exp2_q30((uint32_t)(log2_q60 >> 28));
    uint32_t rounded = (mantissa + 64U) >> 7; /* 24 digits, units of 2^-23 */
    return (float)rounded * ((float)(UINT32_C(1) << whole) / 8388608.0F);
}

float hb_root(float value)
{
    if (!(value > 0.0F)) {
        return 0.0F;
    }
    float root = hb_float_of_bits((hb_bits_of_float(value) >> 1) + UINT32_C(0x1fc00000)); /* within 6 % */
    for (uint32_t i = 0U; i < 3U; i += 1U) {
        root = 0.5F * (root + value / root);
    }
    return root;
}

bool hb_is_finite(float value)
{
    return (hb_bits_of_float(value) & UINT32_C(0x7f800000)) != UINT32_C(0x7f800000);
}

float hb_absolute(float value)
{
    return value < 0.0F ? -value : value;
}

float hb_clamp(float value, float low, float high)
{
    if (value < low) {
        return low;
    }
    return value > high ? high : value;
}

float hb_towards_zero(float value, float step)
{
    if (hb_absolute(value) <= step) {
        return 0.0F;
    }
    return value > 0.0F ? value - step : value + step;
}

/* (1 + 2^-12)^2 = 1 + 2^-11 + 2^-24, of which float keeps all but the last. The compiler does not know the operands, so
 * that it treats this expression as any other. */
bool hb_rounds_once(void)
{
    volatile float factor = 1.0F + 1.0F / 4096.0F;
    volatile float rounded = -(1.0F + 1.0F / 2048.0F);
    float a = factor;
    float b = rounded;
    return a * a + b != 0.0F;
}

uint32_t hb_bits_of_float(float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

float hb_float_of_bits(uint32_t bits)
{
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}
