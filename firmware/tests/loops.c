/* Closed loops: the device's core, a simulated handle and a random hand, with random accepted sets.
 *
 *     loops RUNS SEED [CONTROLS]   each run 3 s; one line for each of the 32 kinds of run
 *
 * The kind of a run is a sum: 1 a slew limit that is felt, 2 positions that are lost, 4 ticks that come late, 8 switches
 * of the set, 16 a force that comes 50 to 400 us late, for which the device checks its sets. The host asks for a START
 * whenever the device is STOPPED, in contact too. A line: kind, runs, ticks while RUNNING, HOLDs, largest force out of
 * contact (N), largest energy made in a touch (mJ): by how much force and physical damping together ever gave the hand
 * more than they had taken from it; STARTs in contact, and touches that began with one; the same energy of touches in
 * which the force was cut, at the limit of its set or at 0, because no force pulls inwards; HOLDs of a hand beyond the
 * velocity limit, which are not among the others.
 * CONTROLS 1: with the passivity controller. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "rig.h"

enum { TICKS = 3000, KINDS = 32, SLEWED = 1, LOSSES = 2, LATE = 4, SWITCHES = 8, DELAYED = 16 };

struct outcome {
    unsigned long runs;
    unsigned long ticks;
    unsigned long holds;
    double out_of_contact_N;
    double made_mJ;
    unsigned long asked_in_contact;
    unsigned long begun_in_contact;
    double cut_mJ;
    unsigned long too_fast;
};

struct loop {
    struct sim_rig rig;
    struct sim_random random;
    int kind;
    double lost_share;
    uint16_t set_id;
    uint8_t seq;
    bool controls;
    bool ran;        /* at the last tick it was RUNNING, */
    bool touched;    /* and in contact */
    bool pressed;    /* in contact, in any state */
    unsigned long asked_in_contact;
    double taken_mJ; /* in this touch */
    bool cut;        /* in this touch */
    bool held;       /* at the last tick */
};

static double draw(struct loop *loop, double low, double high)
{
    return sim_random_uniform(&loop->random, low, high);
}

static bool happens(struct loop *loop, double probability)
{
    return draw(loop, 0.0, 1.0) < probability;
}

static size_t put(uint8_t *payload, size_t at, uint32_t value, size_t size)
{
    for (size_t i = 0U; i < size; i += 1U) {
        payload[at + i] = (uint8_t)(value >> (8U * i));
    }
    return at + size;
}

static size_t put_float(uint8_t *payload, size_t at, double value)
{
    float narrow = (float)value;
    uint32_t bits;
    memcpy(&bits, &narrow, sizeof bits);
    return put(payload, at, bits, 4U);
}

static void send(struct loop *loop, uint8_t type, const uint8_t *payload, size_t size)
{
    uint8_t bytes[HB_MAX_FRAME];
    loop->seq = (uint8_t)(loop->seq + 1U);
    size = hb_frame_write(type, loop->seq, payload, size, bytes);
    for (size_t taken = 0U; taken < size;) {
        taken += hb_receive(&loop->rig.device, bytes + taken, size - taken);
    }
    uint8_t answers[HB_OUTPUT_BYTES];
    (void)hb_transmit(&loop->rig.device, answers, sizeof answers);
}

/* CLEAR of the last stop, or a HEARTBEAT with the newest tick. */
static void send_pair(struct loop *loop, uint8_t type, uint32_t second)
{
    uint8_t payload[8];
    send(loop, type, payload, put(payload, put(payload, 0U, loop->rig.device.boot_id, 4U), second, 4U));
}

static void confirm(struct loop *loop, uint8_t type, uint8_t bank)
{
    const struct hb_device *device = &loop->rig.device;
    uint8_t payload[16];
    size_t at = put(payload, 0U, device->bank[bank].set.set_id, 4U);
    at = put(payload, at, device->crc[bank], 4U);
    at = put(payload, at, device->boot_id, 4U);
    send(loop, type, payload, type == (uint8_t)HB_START ? put(payload, at, device->stops, 4U) : at);
}

/* Sets are drawn until the device takes one: those that it finds passive. */
static void stage(struct loop *loop)
{
    for (unsigned tries = 0U; tries < 1000U; tries += 1U) {
        uint8_t payload[28];
        loop->set_id = (uint16_t)(loop->set_id + 1U);
        size_t at = put(payload, 0U, loop->set_id, 2U);
        at = put(payload, at, HB_SHORT, 2U);
        at = put(payload, at, 1U + 2U * (uint32_t)draw(loop, 0.0, 60.0), 2U);
        at = put(payload, at, 1000U, 2U);
        at = put_float(payload, at, draw(loop, -1.0, 1.8));
        at = put_float(payload, at, exp(draw(loop, log(0.1), log(20.0))));
        at = put_float(payload, at, exp(draw(loop, log(0.02), log(20.0))));
        at = put_float(payload, at, draw(loop, 0.02, 0.9));
        at = put_float(payload, at, draw(loop, 0.5, 20.0));
        send(loop, HB_SET_PARAMS, payload, at);
        if (loop->rig.device.staging != (uint8_t)HB_EMPTY) {
            return;
        }
    }
    (void)fprintf(stderr, "no set was taken\n");
    abort();
}

static void begin(struct loop *loop)
{
    struct sim_rig_config config = sim_rig_defaults();
    config.world.seed = sim_random_bits(&loop->random);
    config.world.mass_kg = draw(loop, 0.1, 0.5);
    config.world.coulomb_N = happens(loop, 0.5) ? 0.02 : 0.0;
    config.world.finger.stiffness_N_per_mm = exp(draw(loop, log(0.1), log(5.0)));
    config.world.finger.damping_N_s_per_m = draw(loop, 0.0, 20.0);
    config.world.finger.shallow_mm = draw(loop, 0.0, 3.0);
    config.world.finger.deep_mm = config.world.finger.shallow_mm + draw(loop, 0.0, 10.0);
    sim_world_start(&loop->rig.world, &config.world);
    loop->rig.config = sim_rig_describe(&config);
    bool slewed = (loop->kind & SLEWED) != 0;
    loop->rig.config.slew_limit_N_per_s = slewed ? (float)exp(draw(loop, log(20.0), log(1000.0))) : 1e6F;
    loop->rig.config.delay_us = (loop->kind & DELAYED) != 0 ? 50U * (uint32_t)draw(loop, 1.0, 9.0) : 0U;
    loop->rig.config.capabilities |= loop->controls ? (uint8_t)HB_CAN_CONTROL_PASSIVITY : 0U;
    loop->rig.bad_ticks = loop->rig.late_ticks = 0U;
    if (hb_init(&loop->rig.device, &loop->rig.config, 7U) != HB_OK) {
        abort();
    }
    loop->lost_share = draw(loop, 0.0, 0.2);
    loop->rig.motor_N = 0.0;
    loop->rig.motor_sign = 1.0;
    loop->rig.encoder_sign = 1;
    loop->rig.stop_open = loop->ran = loop->touched = loop->pressed = loop->cut = loop->held = false;
    loop->rig.late_us = 0U;
    loop->rig.delay_us = loop->rig.config.delay_us;
    loop->asked_in_contact = 0UL;
    uint8_t payload[8];
    send(loop, HB_HELLO, payload, put(payload, put(payload, 0U, HB_PROTOCOL_VERSION, 4U), HB_SCHEMA_CRC, 4U));
    while (!loop->rig.device.in_force) { /* a set may turn out not to be passive at the delay */
        if (loop->rig.device.staging == (uint8_t)HB_EMPTY) {
            stage(loop);
        }
        (void)sim_rig_tick(&loop->rig);
        confirm(loop, HB_COMMIT, (uint8_t)(1U - loop->rig.device.active));
    }
}

/* What a host does between two ticks. */
static void host(struct loop *loop, unsigned tick)
{
    struct hb_device *device = &loop->rig.device;
    if (tick % 50U == 0U) {
        send_pair(loop, HB_HEARTBEAT, device->tick);
    }
    if (tick % 100U == 0U && device->state == (uint8_t)HB_HOLDING) {
        send_pair(loop, HB_CLEAR, device->stops);
    }
    if (tick % 100U == 0U && device->state == (uint8_t)HB_STOPPED) {
        loop->asked_in_contact += device->safety.counts > 0 ? 1UL : 0UL;
        confirm(loop, HB_START, device->active);
    }
    if ((loop->kind & SWITCHES) != 0 && happens(loop, 0.01)) {
        bool busy = device->offset_N != 0.0F || device->flipped;
        if (device->staging == (uint8_t)HB_EMPTY && !busy) {
            stage(loop);
        } else {
            confirm(loop, HB_COMMIT, (uint8_t)(1U - device->active));
        }
    }
    if ((loop->kind & LOSSES) != 0 && happens(loop, loop->lost_share)) {
        loop->rig.bad_ticks = 1U;
    }
}

static void measure(struct loop *loop, double force_N, double before_mm, struct outcome *outcome)
{
    const struct hb_device *device = &loop->rig.device;
    const struct sim_world *world = &loop->rig.world;
    bool running = device->state == (uint8_t)HB_RUNNING, touches = device->safety.counts > 0;
    outcome->ticks += running ? 1U : 0U;
    if (running && !touches) {
        outcome->out_of_contact_N = fmax(outcome->out_of_contact_N, fabs(force_N));
    }
    if (running && touches && !loop->touched) {
        loop->taken_mJ = 0.0;
        loop->cut = false;
    }
    bool at_limit = (device->safety.flags & (uint16_t)HB_FLAG_SATURATED) != 0U;
    loop->cut = loop->cut || at_limit || (loop->touched && touches && force_N == 0.0);
    outcome->begun_in_contact += running && touches && !loop->ran && loop->pressed ? 1UL : 0UL;
    bool held = device->state == (uint8_t)HB_HOLDING;
    if (held && !loop->held) {
        *(device->cause == (uint8_t)HB_CAUSE_VELOCITY ? &outcome->too_fast : &outcome->holds) += 1UL;
    }
    loop->held = held;
    loop->ran = running;
    loop->pressed = touches;
    loop->touched = running && touches;
    if (loop->touched) {
        double moved_mm = world->position_mm - before_mm;
        double speed_m_per_s = moved_mm / (1e3 * world->config.tick_s);
        loop->taken_mJ += (force_N + world->config.damping_N_s_per_m * speed_m_per_s) * moved_mm;
        double *made_mJ = loop->cut ? &outcome->cut_mJ : &outcome->made_mJ;
        *made_mJ = fmax(*made_mJ, -loop->taken_mJ);
    }
}

static void run(struct loop *loop, struct outcome *outcome)
{
    begin(loop);
    for (unsigned tick = 0U; tick < TICKS; tick += 1U) {
        host(loop, tick);
        if ((loop->kind & LATE) != 0 && happens(loop, 0.002)) {
            sim_world_tick(&loop->rig.world, -(double)loop->rig.device.safety.force_N); /* the force goes on meanwhile */
            loop->rig.late_ticks = 1U;
        }
        double before_mm = loop->rig.world.position_mm;
        double force_N = (double)sim_rig_tick(&loop->rig);
        measure(loop, force_N, before_mm, outcome);
    }
    outcome->runs += 1U;
    outcome->asked_in_contact += loop->asked_in_contact;
}

int main(int count, char **arguments)
{
    static struct loop loop;
    static struct outcome outcomes[KINDS];
    unsigned long runs = count > 1 ? strtoul(arguments[1], NULL, 10) : 1000UL;
    loop.random = (struct sim_random){count > 2 ? strtoul(arguments[2], NULL, 10) : 0UL};
    loop.controls = count > 3 && strcmp(arguments[3], "1") == 0;
    for (unsigned long i = 0U; i < runs; i += 1U) {
        loop.kind = (int)(i % KINDS);
        run(&loop, &outcomes[loop.kind]);
    }
    for (int kind = 0; kind < KINDS; kind++) {
        const struct outcome *o = &outcomes[kind];
        (void)printf("%d %lu %lu %lu %.6g %.6g %lu %lu %.6g %lu\n", kind, o->runs, o->ticks, o->holds, o->out_of_contact_N,
                     o->made_mJ, o->asked_in_contact, o->begun_in_contact, o->cut_mJ, o->too_fast);
    }
    return EXIT_SUCCESS;
}
