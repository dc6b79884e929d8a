/* A sketch in C++ with the core: started, ticked, asked for its state. Ends with 0, or prints why the core refused. */
#include <cmath>
#include <cstdio>

#include "hb_device.h"
#include "hb_math.h"
#include "hb_motion.h"
#include "hb_passivity.h"
#include "hb_requests.h"
#include "hb_staging.h"

static hb_device device;

static hb_config describe()
{
    hb_config config = {};
    config.line_rate_baud = 921600;
    config.tick_rate_Hz = 1000;
    config.watchdog_ticks = 250;
    config.hold_ticks = 20;
    config.most_taps = HB_MAX_TAPS;
    config.most_states = HB_MAX_STATES;
    config.capabilities = HB_IS_HOMED_AT_BOOT;
    config.delay_us = 400;
    config.damping_N_s_per_m = 1.0F;
    config.force_limit_N = 5.0F;
    config.continuous_force_N = 2.0F;
    config.heating_s = 10.0F;
    config.position_low_mm = -5.0F;
    config.position_high_mm = 20.0F;
    config.encoder_step_mm = 0.01F;
    config.slew_limit_N_per_s = 500.0F;
    config.velocity_limit_mm_per_s = 1000.0F;
    config.plausible_step_mm = 2.0F;
    config.K0_N_per_mm = {-10.0F, 10.0F};
    config.K1_N_per_mm = {0.001F, 10.0F};
    config.B1_N_s_alpha_per_mm = {0.001F, 10.0F};
    config.alpha = {0.005F, 0.995F};
    return config;
}

int main()
{
    static const hb_config config = describe();
    const hb_error error = hb_init(&device, &config, 1);
    if (error != HB_OK) {
        std::puts(hb_error_sentence(error));
        return 1;
    }
    hb_input input = {};
    input.position_counts = -10;
    input.position_valid = true;
    input.sensed_N = NAN;
    const float force_N = hb_tick(&device, &input);
    uint8_t sent[HB_MAX_FRAME];
    const size_t size = hb_transmit(&device, sent, sizeof sent);
    return device.state == HB_STOPPED && force_N == 0.0F && size > 0 ? 0 : 2;
}
