#include "hb_delay.h"

#include "hb_math.h"
#include "hb_messages.h"

/* Half of the step between two angles, pi/512. */
#define STEP_COSINE 0.99998117528260111F
#define STEP_SINE 0.0061358846491544753F

struct complex {
    float re;
    float im;
};

static struct complex product(struct complex a, struct complex b)
{
    return (struct complex){a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re};
}

static struct complex quotient(struct complex a, struct complex b)
{
    float square = b.re * b.re + b.im * b.im;
    struct complex conjugate = {b.re, -b.im};
    struct complex over = product(a, conjugate);
    return (struct complex){over.re / square, over.im / square};
}

/* C(z) = sum c_i z^-i by Horner's rule; the taps are |c_N| ... |c_1|, and c_0 = 1. `back` is z^-1. */
static struct complex short_pot(const struct hb_renderer *renderer, struct complex back)
{
    struct complex sum = {0.0F, 0.0F};
    for (size_t i = 0U; i < renderer->set.length; i += 1U) {
        sum.re = sum.re - renderer->tap[i];
        sum = product(sum, back);
    }
    sum.re = sum.re + 1.0F;
    return sum;
}

/* C(z) = sum p (1 - z^-1)/(1 - lambda z^-1), where 1 - lambda z^-1 = (1 - z^-1) + loss z^-1. */
static struct complex full_pot(const struct hb_renderer *renderer, struct complex back, struct complex change)
{
    struct complex sum = {0.0F, 0.0F};
    for (size_t k = 0U; k < renderer->set.length; k += 1U) {
        float loss = renderer->loss[k];
        struct complex below = {change.re + loss * back.re, change.im + loss * back.im};
        struct complex part = quotient(change, below);
        sum.re = sum.re + renderer->weight[k] * part.re;
        sum.im = sum.im + renderer->weight[k] * part.im;
    }
    return sum;
}

static float needed_N_per_mm(const struct hb_renderer *renderer, float cosine, float sine, float sigma)
{
    struct complex back = {1.0F - 2.0F * sine * sine, -2.0F * sine * cosine};
    struct complex change = {2.0F * sine * sine, 2.0F * sine * cosine};
    struct complex pot = renderer->set.memory == (uint8_t)HB_FULL ? full_pot(renderer, back, change)
                                                                  : short_pot(renderer, back);
    pot.re = pot.re * renderer->beta_N_per_mm;
    pot.im = pot.im * renderer->beta_N_per_mm;
    struct complex sum = {pot.re + renderer->set.K1_N_per_mm, pot.im};
    struct complex H = quotient(pot, sum); /* K1 pot/(K1 + pot) */
    H.re = renderer->set.K0_N_per_mm + renderer->set.K1_N_per_mm * H.re;
    H.im = renderer->set.K1_N_per_mm * H.im;
    float psi = H.re - cosine / sine * H.im + 2.0F * sigma * product(back, H).re;
    float square = psi * psi + 4.0F * sigma * (1.0F - sigma) * (H.re * H.re + H.im * H.im);
    return 0.5F * (psi + hb_root(square));
}

void hb_delay_begin(struct hb_delay_check *check, const struct hb_config *config)
{
    check->left = config->delay_us > 0U ? HB_DELAY_ANGLES : 0U;
    check->cosine = STEP_COSINE;
    check->sine = STEP_SINE;
    check->largest_N_per_mm = 0.0F;
}

void hb_delay_step(struct hb_delay_check *check, struct hb_renderer *renderer, const struct hb_config *config)
{
    float sigma = (float)config->delay_us * 1e-6F * (float)config->tick_rate_Hz;
    for (uint32_t i = 0U; i < HB_DELAY_ANGLES_PER_TICK && check->left > 0U; i += 1U) {
        float needed = needed_N_per_mm(renderer, check->cosine, check->sine, sigma);
        check->largest_N_per_mm = needed > check->largest_N_per_mm ? needed : check->largest_N_per_mm;
        float cosine = check->cosine * STEP_COSINE - check->sine * STEP_SINE;
        check->sine = check->sine * STEP_COSINE + check->cosine * STEP_SINE;
        check->cosine = cosine;
        check->left -= 1U;
    }
}

uint32_t hb_delay_ticks_left(const struct hb_delay_check *check)
{
    return (check->left + HB_DELAY_ANGLES_PER_TICK - 1U) / HB_DELAY_ANGLES_PER_TICK;
}

bool hb_delay_is_passive(const struct hb_delay_check *check, struct hb_renderer *renderer,
                         const struct hb_config *config)
{
    if (config->delay_us > 0U) {
        float needed = 500.0F / (float)config->tick_rate_Hz * check->largest_N_per_mm * (1.0F + HB_DELAY_MARGIN);
        bool more = !(needed <= renderer->minimum_damping_N_s_per_m);
        renderer->minimum_damping_N_s_per_m = more ? needed : renderer->minimum_damping_N_s_per_m;
    }
    return renderer->minimum_damping_N_s_per_m <= config->damping_N_s_per_m;
}
