/* Passivity of a force that comes late: checked for the longest delay of a device, frequency by frequency.
 *
 * With sigma = delay/T, at the angle theta = omega T, a rendering H needs the damping (T/2) Y,
 *
 *     Y = (psi + sqrt(psi^2 + 4 sigma (1 - sigma) |H|^2))/2,
 *     psi = Re H - cot(theta/2) Im H + 2 sigma Re(exp(-j theta) H);
 *
 * docs/methods/mechanics.md derives it. It has no closed maximum, so that a staged set is looked at on an even grid, two
 * angles a tick, while its history warms up; between the nodes the maximum may be higher by HB_DELAY_MARGIN of itself. */
#ifndef HB_DELAY_H
#define HB_DELAY_H

#include <stdbool.h>
#include <stdint.h>

#include "hb_renderer.h"

#ifdef __cplusplus
extern "C" {
#endif

#define HB_DELAY_ANGLES 256U
#define HB_DELAY_ANGLES_PER_TICK 2U
#define HB_DELAY_MARGIN 5e-4F

struct hb_delay_check {
    uint32_t left; /* angles; 0: done */
    float cosine;  /* of half the next angle */
    float sine;
    float largest_N_per_mm; /* Y so far */
};

/* Begin with a staged set; on a device without delay there is nothing to check. */
void hb_delay_begin(struct hb_delay_check *check, const struct hb_config *config);

/* The next angles of this set. */
void hb_delay_step(struct hb_delay_check *check, struct hb_renderer *renderer, const struct hb_config *config);

/* Ticks until all angles have been looked at. */
uint32_t hb_delay_ticks_left(const struct hb_delay_check *check);

/* The device has the damping that the set needs with and without delay. `renderer` then holds the larger of both needs. */
bool hb_delay_is_passive(const struct hb_delay_check *check, struct hb_renderer *renderer,
                         const struct hb_config *config);

#ifdef __cplusplus
}
#endif

#endif
