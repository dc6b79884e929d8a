#include "hb_drive.h"

#include "hb_math.h"

static bool crosses(float number, float low, float high, float *value, float *limit)
{
    bool outside = number < low || number > high;
    if (outside) {
        *value = number;
        *limit = number < low ? low : high;
    }
    return outside;
}

bool hb_drive_is_named(const struct hb_drive_request *request)
{
    bool nudges = request->shape == (uint8_t)HB_DRIVE_NUDGE;
    return request->shape <= (uint8_t)HB_DRIVE_NUDGE &&
           request->mode <= (uint8_t)(nudges ? HB_DRIVE_FORCE : HB_DRIVE_POSITION);
}

enum hb_reason hb_drive_check(const struct hb_drive_request *request, const struct hb_config *config, float *value,
                              float *limit)
{
    if (!hb_is_finite(request->offset) || !hb_is_finite(request->amplitude)) {
        return HB_NACK_NOT_FINITE;
    }
    bool force = request->mode == (uint8_t)HB_DRIVE_FORCE;
    float low = force ? -config->force_limit_N : config->position_low_mm;
    float high = force ? config->force_limit_N : config->position_high_mm;
    float first = request->offset;
    float last = first;
    if (request->shape == (uint8_t)HB_DRIVE_TRIANGLE) {
        first = request->offset - request->amplitude;
        last = request->offset + request->amplitude;
    } else if (request->shape == (uint8_t)HB_DRIVE_STEP) {
        last = request->amplitude;
    } else if (request->shape == (uint8_t)HB_DRIVE_NUDGE &&
               crosses(request->amplitude, config->encoder_step_mm, config->position_high_mm, value, limit)) {
        return HB_NACK_DRIVE_RANGE;
    }
    bool periodic = request->shape == (uint8_t)HB_DRIVE_TRIANGLE || request->shape == (uint8_t)HB_DRIVE_STEP;
    if (crosses(first, low, high, value, limit) || crosses(last, low, high, value, limit) ||
        crosses((float)request->duration_ticks, 1.0F, (float)HB_MAX_DRIVE_TICKS, value, limit) ||
        (periodic && crosses((float)request->period_ticks, 4.0F, (float)HB_MAX_DRIVE_TICKS, value, limit))) {
        return HB_NACK_DRIVE_RANGE;
    }
    return HB_ACCEPTED;
}

void hb_drive_begin(struct hb_drive *drive, const struct hb_drive_request *request, const struct hb_config *config,
                    const struct hb_safety *safety)
{
    *drive = (struct hb_drive){
        .request = *request,
        .tick = 0U,
        .from_counts = safety->counts,
        .reference_mm = hb_position_mm(safety, config),
        .integral_N = 0.0F,
        .seen_counts = safety->counts,
        .still_ticks = 0U,
    };
}

bool hb_drive_has_ended(const struct hb_drive *drive, const struct hb_config *config, const struct hb_safety *safety)
{
    float moved_mm = hb_absolute((float)(safety->counts - drive->from_counts) * config->encoder_step_mm);
    bool nudged = drive->request.shape == (uint8_t)HB_DRIVE_NUDGE && moved_mm >= drive->request.amplitude;
    return nudged || drive->tick >= drive->request.duration_ticks;
}

bool hb_drive_is_stuck(const struct hb_drive *drive, const struct hb_config *config)
{
    return drive->still_ticks >= config->tick_rate_Hz / HB_STUCK_PER_S;
}

/* Begins at the offset and rises. */
static float triangle(const struct hb_drive_request *request, uint32_t tick)
{
    float phase = (float)(tick % request->period_ticks) / (float)request->period_ticks;
    float height = 4.0F * phase;
    if (phase >= 0.75F) {
        height = height - 4.0F;
    } else if (phase >= 0.25F) {
        height = 2.0F - height;
    }
    return request->offset + request->amplitude * height;
}

static float wanted(const struct hb_drive *drive)
{
    const struct hb_drive_request *request = &drive->request;
    if (request->shape == (uint8_t)HB_DRIVE_TRIANGLE) {
        return triangle(request, drive->tick);
    }
    bool late = request->shape == (uint8_t)HB_DRIVE_STEP && drive->tick >= request->period_ticks;
    return late ? request->amplitude : request->offset;
}

/* Counts for how long the handle has not moved while the servo pushes it. Where its reference comes back, friction may
 * rightly keep the handle where it is. `ahead_mm`: how the reference moved. */
static void watch(struct hb_drive *drive, const struct hb_config *config, int32_t counts, float ahead_mm,
                  float error_mm, float force_N)
{
    float far_mm = (float)HB_STUCK_STEPS * config->encoder_step_mm;
    float strong_N = HB_STUCK_FORCE * config->force_limit_N;
    bool inwards = error_mm > far_mm && force_N > strong_N && ahead_mm >= 0.0F;
    bool outwards = error_mm < -far_mm && force_N < -strong_N && ahead_mm <= 0.0F;
    bool pushes = inwards || outwards;
    int32_t moved = counts - drive->seen_counts;
    if (!pushes || moved > 1 || moved < -1) {
        drive->seen_counts = counts;
        drive->still_ticks = 0U;
    } else if (!hb_drive_is_stuck(drive, config)) {
        drive->still_ticks += 1U;
    }
}

/* Inward force of a PI servo with damping on the measured velocity. */
static float servo(struct hb_drive *drive, const struct hb_config *config, const struct hb_safety *safety,
                   float goal_mm)
{
    float rate_Hz = (float)config->tick_rate_Hz;
    float reach_mm = config->servo_speed_mm_per_s / rate_Hz;
    float before_mm = drive->reference_mm;
    drive->reference_mm = hb_clamp(goal_mm, drive->reference_mm - reach_mm, drive->reference_mm + reach_mm);
    float error_mm = drive->reference_mm - hb_position_mm(safety, config);
    float step_mm = (float)safety->step_counts * config->encoder_step_mm;
    float integral_N = drive->integral_N + config->servo_integral_N_per_mm_s * error_mm / rate_Hz;
    drive->integral_N = hb_clamp(integral_N, -config->force_limit_N, config->force_limit_N);
    float force_N = config->servo_stiffness_N_per_mm * error_mm + drive->integral_N -
                    config->servo_damping_N_s_per_mm * (step_mm * rate_Hz / (float)safety->step_ticks);
    watch(drive, config, safety->counts, drive->reference_mm - before_mm, error_mm, force_N);
    return force_N;
}

float hb_drive_step(struct hb_drive *drive, const struct hb_config *config, const struct hb_safety *safety)
{
    float value = wanted(drive);
    drive->tick += 1U;
    return drive->request.mode == (uint8_t)HB_DRIVE_FORCE ? -value : -servo(drive, config, safety, value);
}
