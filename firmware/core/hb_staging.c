#include "hb_staging.h"

#include "hb_math.h"
#include "hb_passivity.h"

static struct hb_renderer *idle_bank(struct hb_device *device)
{
    return &device->bank[1U - device->active];
}

static bool is_outside(float number, struct hb_range range, struct hb_nack *nack)
{
    nack->value = number;
    nack->limit = number < range.low ? range.low : range.high;
    return number < range.low || number > range.high;
}

static enum hb_reason check_numbers(const struct hb_config *config, const struct hb_parameters *set,
                                    struct hb_nack *nack)
{
    struct hb_range forces = {.low = 0.0F, .high = config->force_limit_N};
    if (!hb_is_finite(set->K0_N_per_mm) || !hb_is_finite(set->K1_N_per_mm) ||
        !hb_is_finite(set->B1_N_s_alpha_per_mm) || !hb_is_finite(set->alpha) || !hb_is_finite(set->force_limit_N)) {
        return HB_NACK_NOT_FINITE;
    }
    if (is_outside(set->K0_N_per_mm, config->K0_N_per_mm, nack)) {
        return HB_NACK_K0_RANGE;
    }
    if (is_outside(set->K1_N_per_mm, config->K1_N_per_mm, nack)) {
        return HB_NACK_K1_RANGE;
    }
    if (is_outside(set->B1_N_s_alpha_per_mm, config->B1_N_s_alpha_per_mm, nack)) {
        return HB_NACK_B1_RANGE;
    }
    if (is_outside(set->alpha, config->alpha, nack)) {
        return HB_NACK_ALPHA_RANGE;
    }
    if (is_outside(set->force_limit_N, forces, nack)) {
        return HB_NACK_FORCE_LIMIT;
    }
    return HB_ACCEPTED;
}

static enum hb_reason check_sampling(const struct hb_config *config, const struct hb_parameters *set,
                                     struct hb_nack *nack)
{
    uint16_t most = set->memory == (uint8_t)HB_SHORT ? config->most_taps : config->most_states;
    if (set->tick_rate_Hz != config->tick_rate_Hz) {
        nack->value = (float)set->tick_rate_Hz;
        nack->limit = (float)config->tick_rate_Hz;
        return HB_NACK_TICK_RATE;
    }
    nack->value = (float)set->length;
    nack->limit = (float)most;
    if (set->length == 0U || set->length > most) {
        return HB_NACK_MEMORY_LENGTH;
    }
    if (set->memory == (uint8_t)HB_SHORT && set->length % 2U == 0U) {
        return HB_NACK_EVEN_TAPS;
    }
    return HB_ACCEPTED;
}

static enum hb_reason check_passivity(const struct hb_config *config, const struct hb_renderer *renderer,
                                      struct hb_nack *nack)
{
    if (!renderer->static_is_passive) {
        nack->value = renderer->static_stiffness_N_per_mm;
        nack->limit = 0.0F;
        return HB_NACK_STATIC_STIFFNESS;
    }
    if (!(renderer->minimum_damping_N_s_per_m <= config->damping_N_s_per_m)) {
        nack->value = renderer->minimum_damping_N_s_per_m;
        nack->limit = config->damping_N_s_per_m;
        return HB_NACK_NOT_PASSIVE;
    }
    return HB_ACCEPTED;
}

/* From here on the staged set follows the same motion, beginning at the equilibrium of where the device is. */
static void begin_history(struct hb_device *device)
{
    struct hb_renderer *idle = idle_bank(device);
    hb_renderer_rest(idle, hb_penetration_mm(&device->safety, device->config));
    device->warm_left = idle->warm_ticks;
    device->staging = (uint8_t)HB_WARMING;
    hb_delay_begin(&device->delay_check, device->config);
}

void hb_rest_histories(struct hb_device *device)
{
    float x_mm = hb_penetration_mm(&device->safety, device->config);
    hb_renderer_rest(&device->bank[0], x_mm);
    hb_renderer_rest(&device->bank[1], x_mm);
}

enum hb_reason hb_stage_parameters(struct hb_device *device, const struct hb_frame *frame, struct hb_nack *nack)
{
    struct hb_parameters set;
    bool in_order = hb_unpack_parameters(frame->payload, &set);
    if (!in_order || set.set_id == 0U || set.memory > (uint8_t)HB_FULL) {
        return HB_NACK_RESERVED;
    }
    nack->ticks = hb_busy_ticks(device);
    if (nack->ticks > 0U) {
        return HB_NACK_BUSY;
    }
    device->staging = (uint8_t)HB_EMPTY;
    enum hb_reason reason = check_numbers(device->config, &set, nack);
    if (reason == HB_ACCEPTED) {
        reason = check_sampling(device->config, &set, nack);
    }
    if (reason != HB_ACCEPTED) {
        return reason;
    }
    struct hb_renderer *idle = idle_bank(device);
    hb_renderer_prepare(idle, &set);
    reason = check_passivity(device->config, idle, nack);
    if (reason != HB_ACCEPTED) {
        return reason;
    }
    device->crc[1U - device->active] = hb_crc32(0U, frame->payload, frame->size);
    device->states_known = 0U;
    device->staging = (uint8_t)HB_INCOMPLETE;
    if (set.memory == (uint8_t)HB_SHORT) {
        begin_history(device);
    }
    return HB_ACCEPTED;
}

enum hb_reason hb_stage_states(struct hb_device *device, const struct hb_frame *frame)
{
    struct hb_states states;
    struct hb_renderer *idle = idle_bank(device);
    uint32_t *crc = &device->crc[1U - device->active];
    bool incomplete = device->staging == (uint8_t)HB_INCOMPLETE;
    if (device->staging == (uint8_t)HB_EMPTY) {
        return HB_NACK_NOTHING_STAGED;
    }
    hb_unpack_states(frame->payload, &states);
    device->staging = (uint8_t)HB_EMPTY; /* unless all is well */
    if (!incomplete || states.set_id != idle->set.set_id || states.first != device->states_known ||
        states.count == 0U || states.count > 7U || states.first + states.count > idle->set.length) {
        return HB_NACK_STATES;
    }
    for (size_t i = 0U; i < states.count; i += 1U) {
        hb_renderer_set_state(idle, states.first + i, states.weight[i], states.loss[i]);
    }
    *crc = hb_crc32(*crc, frame->payload, frame->size);
    device->states_known = (uint16_t)(device->states_known + states.count);
    if (device->states_known < idle->set.length) {
        device->staging = (uint8_t)HB_INCOMPLETE;
    } else if (hb_renderer_accept_states(idle)) {
        begin_history(device);
    } else {
        return HB_NACK_STATES;
    }
    return HB_ACCEPTED;
}

enum hb_staging hb_staging_now(const struct hb_device *device, uint32_t *ticks)
{
    *ticks = 0U;
    if (device->staging != (uint8_t)HB_WARMING) {
        return device->staging == (uint8_t)HB_EMPTY ? HB_EMPTY : HB_INCOMPLETE;
    }
    uint32_t check = hb_delay_ticks_left(&device->delay_check);
    uint32_t warm = hb_in_contact(&device->safety) ? device->warm_left : 0U;
    *ticks = check > warm ? check : warm;
    return *ticks == 0U ? HB_READY : HB_WARMING;
}

static bool names(const struct hb_confirmation *confirmation, const struct hb_device *device, uint8_t bank)
{
    return confirmation->set_id == device->bank[bank].set.set_id && confirmation->crc == device->crc[bank];
}

enum hb_reason hb_commit(struct hb_device *device, const struct hb_confirmation *confirmation, struct hb_nack *nack)
{
    uint8_t idle = (uint8_t)(1U - device->active);
    if (device->in_force && names(confirmation, device, device->active)) {
        return HB_ACCEPTED;
    }
    if (device->staging == (uint8_t)HB_EMPTY) {
        return HB_NACK_NOTHING_STAGED;
    }
    if (!names(confirmation, device, idle)) {
        return HB_NACK_SET_MISMATCH;
    }
    enum hb_staging staging = hb_staging_now(device, &nack->ticks);
    if (staging != HB_READY) {
        return staging == HB_INCOMPLETE ? HB_NACK_STATES : HB_NACK_NOT_READY;
    }
    if (!hb_delay_is_passive(&device->delay_check, &device->bank[idle], device->config)) {
        device->staging = (uint8_t)HB_EMPTY;
        nack->value = device->bank[idle].minimum_damping_N_s_per_m;
        nack->limit = device->config->damping_N_s_per_m;
        return HB_NACK_NOT_PASSIVE;
    }
    nack->ticks = hb_busy_ticks(device);
    if (nack->ticks > 0U) {
        return HB_NACK_BUSY;
    }
    if (!hb_in_contact(&device->safety)) {
        hb_renderer_rest(&device->bank[idle], 0.0F);
    }
    device->flipped = device->in_force;
    device->in_force = true;
    device->active = idle;
    device->staging = (uint8_t)HB_EMPTY;
    return HB_ACCEPTED;
}

uint32_t hb_busy_ticks(const struct hb_device *device)
{
    float step_N = device->config->slew_limit_N_per_s / (float)device->config->tick_rate_Hz;
    float ticks = hb_absolute(device->offset_N) / step_N;
    uint32_t more = device->flipped ? 1U : 0U;
    if (device->offset_N != 0.0F) {
        more += 1U;
    }
    return ticks < 1e9F ? more + (uint32_t)ticks : UINT32_C(1000000000);
}

float hb_render(struct hb_device *device, float x_mm, float *old_N)
{
    struct hb_renderer *idle = idle_bank(device);
    *old_N = 0.0F;
    if (device->flipped || device->offset_N != 0.0F) {
        *old_N = hb_renderer_step(idle, x_mm);
    } else if (device->staging == (uint8_t)HB_WARMING) {
        (void)hb_renderer_step(idle, x_mm);
        hb_delay_step(&device->delay_check, idle, device->config);
        if (device->warm_left > 0U) {
            device->warm_left -= 1U;
        }
    }
    return device->in_force ? hb_renderer_step(&device->bank[device->active], x_mm) : 0.0F;
}
