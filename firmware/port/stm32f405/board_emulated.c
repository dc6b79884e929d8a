/* The board in the emulator (qemu-system-arm -M netduinoplus2), which has the processor, the system timer, USART1 and 2,
 * and counters without pins. Everything else is simulated here: a handle with a finger, as seen by a counter of 16 bits,
 * and a command in the steps of the real output. There is no watchdog and no flash.
 *
 * The emulator gives its counters 1 GHz. It wakes the processor late when the computer that it runs on is busy; as no
 * processor does, time stands still meanwhile. USART2 is the hand of a test; one letter each:
 *
 *     0 to 6   a finger that presses so (enum sim_press); at the start it rests where the handle is
 *     o, c     the stop is open, closed
 *     b        the next position is no number
 *     l        the next tick begins 2 ms late
 *     m        likewise, with interrupts off, so that a tick is lost
 *     r        answers "ticks mean most delay driver\n": instructions of a tick from reading the position to the force,
 *              at -icount shift=3, the longest delay in us, and whether the driver is on; then counting begins anew */
#include <math.h>

#include "board.h"
#include "cortex_m.h"
#include "registers.h"
#include "uart.h"
#include "world.h"

enum {
    CLOCK_HZ = 168000000,
    COUNTER_HZ = 1000000000,
    FULL_STEPS = 8400,
    SUBSTEPS = 10, /* the processor has no double precision in hardware */
    INSTRUCTION_NS = 8,
    LATE_US = 2000,
};

struct cost {
    uint32_t ticks;
    uint32_t most;
    uint64_t total;
    uint32_t longest_us;
};

static struct {
    const struct settings *settings;
    struct sim_world world;
    float force_N;
    bool driver_is_on;
    bool stop_is_open;
    bool encoder_is_bad;
    bool is_late;
    bool is_masked;
    uint32_t began_ns;
    uint32_t period_us;
    uint32_t next_due_us;
    uint32_t skipped_us;
    struct cost cost;
} board;

static void start_counter(uint32_t timer, uint32_t rate_Hz)
{
    *TIM_PSC(timer) = COUNTER_HZ / rate_Hz - 1U;
    *TIM_ARR(timer) = UINT32_C(0xFFFFFFFF);
    *TIM_EGR(timer) = TIM_EGR_UPDATE;
    *TIM_CR1(timer) = TIM_CR1_ON;
}

static void start_world(const struct hb_config *config)
{
    struct sim_world_config world = sim_world_defaults();
    world.tick_s = 1.0 / (double)config->tick_rate_Hz;
    world.substeps = SUBSTEPS;
    world.encoder_step_mm = (double)config->encoder_step_mm;
    world.low_mm = (double)config->position_low_mm + 0.1;
    world.high_mm = (double)config->position_high_mm - 0.1;
    world.finger.press = SIM_PRESS_REST;
    sim_world_start(&board.world, &world);
}

const char *board_start(const struct settings *settings, const struct hb_config *config)
{
    board.settings = settings;
    start_counter(TIM5, 1000000);
    start_counter(TIM2, COUNTER_HZ);
    start_world(config);
    uart_start(CLOCK_HZ / 2U, config->line_rate_baud);
    *USART_CR1(USART2) = USART_CR1_ON | USART_CR1_SEND | USART_CR1_RECEIVE;
    return settings_fault(settings, config);
}

uint8_t board_capabilities(void)
{
    return HB_IS_SIMULATED;
}

/* Nothing outlives a reset here: boot ids differ by the time at which the line first speaks. */
uint32_t board_boot_id(void)
{
    while (!uart_has_received()) {
        cortex_m_interrupts_off();
        if (!uart_has_received()) {
            cortex_m_wait();
        }
        cortex_m_interrupts_on();
    }
    return *TIM_CNT(TIM2) * UINT32_C(2654435761) | 1U;
}

uint32_t board_micros(void)
{
    return *TIM_CNT(TIM5) - board.skipped_us;
}

void board_start_ticks(uint32_t rate_Hz)
{
    board.period_us = 1000000U / rate_Hz;
    board.next_due_us = board_micros() + board.period_us;
    cortex_m_start_systick(CLOCK_HZ, rate_Hz);
}

static bool has_passed(uint32_t time_us)
{
    return board_micros() - time_us < UINT32_C(0x80000000);
}

void board_wait(void)
{
    while (has_passed(board.next_due_us)) {
        board.next_due_us += board.period_us;
    }
    cortex_m_wait();
    if ((*CORTEX_M_PENDING & CORTEX_M_PENDING_SYSTICK) != 0U && has_passed(board.next_due_us)) {
        board.skipped_us += board_micros() - board.next_due_us;
        *CORTEX_M_SYSTICK_VALUE = 0; /* the next period begins now */
    }
}

void board_start_watchdog(uint32_t period_us)
{
    (void)period_us;
}

static void say(const char *text)
{
    for (; *text != '\0'; text++) {
        *USART_DR(USART2) = (uint8_t)*text;
    }
}

static void say_number(uint32_t value, const char *end)
{
    char text[11];
    char *first = &text[sizeof text - 1];
    *first = '\0';
    do {
        *--first = (char)('0' + (char)(value % 10U));
        value /= 10U;
    } while (value != 0U);
    say(first);
    say(end);
}

static void report(void)
{
    struct cost *cost = &board.cost;
    const uint64_t mean = cost->ticks > 0U ? cost->total / cost->ticks : 0U;
    say_number(cost->ticks, " ");
    say_number((uint32_t)mean, " ");
    say_number(cost->most, " ");
    say_number(cost->longest_us, " ");
    say_number(board.driver_is_on ? 1U : 0U, "\n");
    *cost = (struct cost){0};
}

static void obey(uint8_t letter)
{
    if (letter >= '0' && letter < '0' + SIM_PRESS_KINDS) {
        sim_world_press(&board.world, (enum sim_press)(letter - '0'));
    } else if (letter == 'o' || letter == 'c') {
        board.stop_is_open = letter == 'o';
    } else if (letter == 'b') {
        board.encoder_is_bad = true;
    } else if (letter == 'l' || letter == 'm') {
        board.is_late = true;
        board.is_masked = letter == 'm';
    } else if (letter == 'r') {
        report();
    }
}

static void count_cost(void)
{
    struct cost *cost = &board.cost;
    const uint32_t instructions = (*TIM_CNT(TIM2) - board.began_ns) / INSTRUCTION_NS;
    cost->ticks++;
    cost->total += instructions;
    cost->most = instructions > cost->most ? instructions : cost->most;
}

/* An open stop and a driver that is off let no force through. */
void board_tick_is_over(uint32_t delay_us)
{
    board.cost.longest_us = delay_us > board.cost.longest_us ? delay_us : board.cost.longest_us;
    const bool drives = board.driver_is_on && !board.stop_is_open;
    board.encoder_is_bad = false;
    sim_world_tick(&board.world, drives ? -(double)board.force_N : 0.0);
    if ((*USART_SR(USART2) & USART_SR_RECEIVED) != 0U) {
        obey((uint8_t)*USART_DR(USART2));
    }
    if (board.is_late) {
        const uint32_t began_us = board_micros();
        board.is_late = false;
        if (board.is_masked) {
            cortex_m_interrupts_off();
        }
        while (board_micros() - began_us < LATE_US) {
        }
        cortex_m_interrupts_on();
    }
}

uint16_t board_encoder_counter(void)
{
    board.began_ns = *TIM_CNT(TIM2);
    return (uint16_t)(sim_world_counts(&board.world) * board.settings->encoder_sign);
}

bool board_encoder_is_good(void)
{
    return !board.encoder_is_bad;
}

float board_sensed_N(void)
{
    return (float)sim_world_sensed_N(&board.world);
}

bool board_stop_is_open(void)
{
    return board.stop_is_open;
}

void board_output(float force_N)
{
    const int32_t steps = settings_steps(board.settings, force_N, FULL_STEPS);
    const float share = (float)(steps * board.settings->motor_sign) / (float)FULL_STEPS;
    board.force_N = share * board.settings->full_scale_N;
    board.driver_is_on = true;
    count_cost();
}

uint32_t board_output_delay_us(void)
{
    return 1000000U / board.settings->pwm_Hz;
}

void board_output_off(void)
{
    board.driver_is_on = false;
    board.force_N = 0.0F;
}

_Noreturn void board_fault(void)
{
    say("fault\n");
    for (;;) {
        cortex_m_wait();
    }
}
