/* The board as it is: an STM32F405 with its crystal. Never run on hardware; the tests run it on a model of the registers.
 *
 *     PA4        DAC 1: the force, where the output is SETTINGS_DAC
 *     PA6        stop: the second contact, to ground; open is high. Also TIM1's break, which ends PWM without software
 *     PA8, PA9   TIM1 channels 1 and 2: PWM, or PWM and sign
 *     PB4, PB5   TIM3 channels 1 and 2: encoder A and B
 *     PB6, PB7   USART1: sent and received
 *     PB12       the motor's driver: high is on. A resistor on the board holds it low while the processor does not */
#include <math.h>
#include <stddef.h>

#include "board.h"
#include "boot_id.h"
#include "cortex_m.h"
#include "registers.h"
#include "uart.h"

enum {
    CLOCK_HZ = 168000000,       /* of the processor and TIM1, once the PLL runs */
    APB2_HZ = 84000000,         /* of USART1 */
    TIMER_HZ = 84000000,        /* of TIM3 and TIM5 */
    RESET_CLOCK_HZ = 16000000,  /* of everything, before that */
    MOST_WAITS = 1000000,       /* about half a second */
    PIN_DAC = 4,
    PIN_STOP = 6,
    PIN_PWM_1 = 8,
    PIN_PWM_2 = 9,
    PIN_ENCODER_A = 4,
    PIN_ENCODER_B = 5,
    PIN_SENT = 6,
    PIN_RECEIVED = 7,
    PIN_DRIVER = 12,
    FUNCTION_TIM1 = 1,
    FUNCTION_TIM3 = 2,
    FUNCTION_USART1 = 7,
    DAC_ZERO = 2048,
    DAC_FULL = 2047,
};

static const struct settings *settings;
static int32_t full_steps;

static void set_pin(uint32_t port, uint32_t pin, bool high)
{
    *GPIO_BSRR(port) = UINT32_C(1) << (pin + (high ? 0U : 16U));
}

static void set_field(volatile uint32_t *value, uint32_t at, uint32_t mask, uint32_t field)
{
    *value = (*value & ~(mask << at)) | field << at;
}

static void set_mode(uint32_t port, uint32_t pin, enum gpio_mode mode, enum gpio_pull pull)
{
    set_field(GPIO_PUPDR(port), 2U * pin, 3U, (uint32_t)pull);
    set_field(GPIO_MODER(port), 2U * pin, 3U, (uint32_t)mode);
}

static void set_function(uint32_t port, uint32_t pin, uint32_t function, enum gpio_pull pull)
{
    set_field(GPIO_AFR(port, pin), 4U * (pin % 8U), 15U, function);
    set_mode(port, pin, GPIO_ALTERNATE, pull);
}

/* The chip takes a few cycles to do so, in which what is written to the peripheral is lost. */
static void enable_clock(volatile uint32_t *clocks, uint32_t bits)
{
    *clocks |= bits;
    (void)*clocks;
    cortex_m_barrier();
}

static bool wait_for(volatile uint32_t *value, uint32_t mask, uint32_t wanted)
{
    uint32_t left = MOST_WAITS;
    while ((*value & mask) != wanted && left > 0U) {
        left--;
    }
    return left > 0U;
}

/* The crystal divided to 2 MHz, times 168, by 2. False where crystal or PLL does not start. */
static bool start_clock(void)
{
    *RCC_CR |= RCC_CR_HSEON;
    if (!wait_for(RCC_CR, RCC_CR_HSERDY, RCC_CR_HSERDY)) {
        return false;
    }
    enable_clock(RCC_APB1ENR, RCC_APB1_PWR);
    *PWR_CR |= PWR_CR_VOS;
    *FLASH_ACR = FLASH_ACR_5_WAIT_STATES | FLASH_ACR_PREFETCH | FLASH_ACR_INSTRUCTION_CACHE | FLASH_ACR_DATA_CACHE;
    *RCC_PLLCFGR = settings->crystal_Hz / 2000000U | UINT32_C(168) << 6 | RCC_PLLCFGR_FROM_HSE | UINT32_C(7) << 24;
    *RCC_CR |= RCC_CR_PLLON;
    if (!wait_for(RCC_CR, RCC_CR_PLLRDY, RCC_CR_PLLRDY)) {
        return false;
    }
    *RCC_CFGR = RCC_CFGR_APB1_BY_4 | RCC_CFGR_APB2_BY_2;
    *RCC_CFGR |= RCC_CFGR_SW_PLL;
    if (!wait_for(RCC_CFGR, RCC_CFGR_SWS, RCC_CFGR_SWS_PLL)) {
        return false;
    }
    *RCC_CR |= RCC_CR_CSSON;
    return true;
}

static void start_micros(uint32_t timer_Hz)
{
    enable_clock(RCC_APB1ENR, RCC_APB1_TIM5);
    *TIM_PSC(TIM5) = timer_Hz / 1000000U - 1U;
    *TIM_ARR(TIM5) = UINT32_C(0xFFFFFFFF);
    *TIM_EGR(TIM5) = TIM_EGR_UPDATE; /* takes the divider over */
    *TIM_CR1(TIM5) = TIM_CR1_ON;
}

static void start_line(uint32_t clock_Hz, uint32_t baud)
{
    enable_clock(RCC_APB2ENR, RCC_APB2_USART1);
    set_function(GPIOB, PIN_SENT, FUNCTION_USART1, GPIO_NO_PULL);
    set_function(GPIOB, PIN_RECEIVED, FUNCTION_USART1, GPIO_PULL_UP); /* a line that is unplugged is idle */
    uart_start(clock_Hz, baud);
}

static void start_encoder(void)
{
    enable_clock(RCC_APB1ENR, RCC_APB1_TIM3);
    set_function(GPIOB, PIN_ENCODER_A, FUNCTION_TIM3, GPIO_PULL_UP);
    set_function(GPIOB, PIN_ENCODER_B, FUNCTION_TIM3, GPIO_PULL_UP);
    *TIM_ARR(TIM3) = 0xFFFF;
    *TIM_CCMR1(TIM3) = TIM_CCMR1_INPUTS_DIRECT | TIM_CCMR1_FILTER_OF_8;
    *TIM_SMCR(TIM3) = TIM_SMCR_ENCODER_OF_BOTH;
    *TIM_CR1(TIM3) = TIM_CR1_ON;
}

/* At 0, and off until board_output. */
static void start_pwm(void)
{
    const bool two = settings->output == SETTINGS_TWO_PWM;
    enable_clock(RCC_APB2ENR, RCC_APB2_TIM1);
    full_steps = (int32_t)((uint32_t)CLOCK_HZ / settings->pwm_Hz);
    *TIM_ARR(TIM1) = (uint32_t)full_steps - 1U;
    *TIM_CCMR1(TIM1) = TIM_CCMR1_PWM_PRELOADED;
    *TIM_CCR1(TIM1) = 0;
    *TIM_CCR2(TIM1) = 0;
    *TIM_CCER(TIM1) = TIM_CCER_BOTH;
    *TIM_BDTR(TIM1) = TIM_BDTR_BREAK | TIM_BDTR_BREAK_HIGH | TIM_BDTR_IDLE_DRIVEN;
    *TIM_EGR(TIM1) = TIM_EGR_UPDATE;
    *TIM_CR1(TIM1) = TIM_CR1_ON | TIM_CR1_PRELOAD;
    set_function(GPIOA, PIN_PWM_1, FUNCTION_TIM1, GPIO_PULL_DOWN);
    if (two) {
        set_function(GPIOA, PIN_PWM_2, FUNCTION_TIM1, GPIO_PULL_DOWN);
    } else {
        set_pin(GPIOA, PIN_PWM_2, false);
        set_mode(GPIOA, PIN_PWM_2, GPIO_OUTPUT, GPIO_NO_PULL);
    }
}

static void start_dac(void)
{
    enable_clock(RCC_APB1ENR, RCC_APB1_DAC);
    full_steps = DAC_FULL;
    *DAC_DHR12R1 = DAC_ZERO;
    set_mode(GPIOA, PIN_DAC, GPIO_ANALOG, GPIO_NO_PULL);
    *DAC_CR = DAC_CR_CHANNEL_1;
}

/* First of all, and on the clock of the reset: the driver is off. */
static void start_pins(void)
{
    enable_clock(RCC_AHB1ENR, RCC_AHB1_GPIOA | RCC_AHB1_GPIOB);
    set_pin(GPIOB, PIN_DRIVER, false);
    set_mode(GPIOB, PIN_DRIVER, GPIO_OUTPUT, GPIO_NO_PULL);
    set_function(GPIOA, PIN_STOP, FUNCTION_TIM1, GPIO_PULL_UP); /* a broken wire is an open stop */
}

const char *board_start(const struct settings *given, const struct hb_config *config)
{
    settings = given;
    start_pins();
    const char *sentence = settings_fault(given, config);
    if (sentence == NULL && !start_clock()) {
        sentence = "The crystal or its PLL does not start: look at crystal_Hz, and at the crystal.";
    }
    const bool good = sentence == NULL;
    start_micros(good ? TIMER_HZ : RESET_CLOCK_HZ);
    start_line(good ? APB2_HZ : RESET_CLOCK_HZ, config->line_rate_baud);
    if (good) {
        start_encoder();
        (given->output == SETTINGS_DAC ? start_dac : start_pwm)();
    }
    return sentence;
}

uint8_t board_capabilities(void)
{
    return 0;
}

static bool wait_for_flash(void)
{
    while ((*FLASH_SR & FLASH_SR_BUSY) != 0U) {
    }
    return (*FLASH_SR & FLASH_SR_ERRORS) == 0U;
}

static void unlock_flash(void)
{
    if ((*FLASH_CR & FLASH_CR_LOCK) != 0U) {
        *FLASH_KEYR = FLASH_KEY_1;
        *FLASH_KEYR = FLASH_KEY_2;
    }
    (void)wait_for_flash();
    *FLASH_SR = FLASH_SR_ERRORS;
}

/* Takes a second or two, in which the processor waits: only before ticks and watchdog run. What the cache has of the
 * sector is old then. */
static bool erase(unsigned sector)
{
    unlock_flash();
    *FLASH_CR = FLASH_CR_ERASE_SECTOR | FLASH_CR_BY_WORDS | (10U + sector) << FLASH_CR_SECTOR_AT;
    *FLASH_CR |= FLASH_CR_START;
    const bool good = wait_for_flash();
    *FLASH_CR = FLASH_CR_LOCK;
    *FLASH_ACR &= ~(uint32_t)FLASH_ACR_DATA_CACHE;
    *FLASH_ACR |= FLASH_ACR_DATA_CACHE_RESET;
    *FLASH_ACR &= ~(uint32_t)FLASH_ACR_DATA_CACHE_RESET;
    *FLASH_ACR |= FLASH_ACR_DATA_CACHE;
    return good;
}

static bool program(const volatile uint32_t *where, uint32_t value)
{
    unlock_flash();
    *FLASH_CR = FLASH_CR_PROGRAM | FLASH_CR_BY_WORDS;
    *register_at((uintptr_t)where) = value;
    const bool good = wait_for_flash();
    *FLASH_CR = FLASH_CR_LOCK;
    return good;
}

uint32_t board_boot_id(void)
{
    const struct boot_flash flash = {
        .sector = {register_at(0x080C0000U), register_at(0x080E0000U)}, /* 10 and 11 */
        .words = 128U * 1024U / 4U,
        .erase = erase,
        .program = program,
    };
    return boot_id_next(&flash);
}

uint32_t board_micros(void)
{
    return *TIM_CNT(TIM5);
}

void board_start_ticks(uint32_t rate_Hz)
{
    cortex_m_start_systick(CLOCK_HZ, rate_Hz);
}

void board_wait(void)
{
    cortex_m_wait();
}

/* Its clock has 17 to 47 kHz, 32 as a rule, divided by 4. */
void board_start_watchdog(uint32_t period_us)
{
    *IWDG_KR = IWDG_KEY_START;
    *IWDG_KR = IWDG_KEY_UNLOCK;
    *IWDG_PR = 0;
    *IWDG_RLR = period_us / 25U - 1U;
    (void)wait_for(IWDG_SR, 3U, 0U);
    *IWDG_KR = IWDG_KEY_FEED;
}

void board_tick_is_over(uint32_t delay_us)
{
    (void)delay_us;
    *IWDG_KR = IWDG_KEY_FEED;
}

uint16_t board_encoder_counter(void)
{
    return (uint16_t)*TIM_CNT(TIM3);
}

/* Two signals without an index tell nothing of themselves. A receiver with a fault output is read here. */
bool board_encoder_is_good(void)
{
    return true;
}

/* A force sensor is read here, and HB_CAN_SENSE_FORCE written into the config. */
float board_sensed_N(void)
{
    return NAN;
}

bool board_stop_is_open(void)
{
    return (*GPIO_IDR(GPIOA) >> PIN_STOP & 1U) != 0U;
}

/* The break has switched the main output off while the stop was open, so that it is switched on again. A sign changes
 * before its magnitude, by one period of the PWM at most. */
void board_output(float force_N)
{
    const int32_t steps = settings_steps(settings, force_N, full_steps);
    const uint32_t size = (uint32_t)(steps < 0 ? -steps : steps);
    switch (settings->output) {
    case SETTINGS_TWO_PWM:
        *TIM_CCR1(TIM1) = steps > 0 ? size : 0U;
        *TIM_CCR2(TIM1) = steps < 0 ? size : 0U;
        *TIM_BDTR(TIM1) |= TIM_BDTR_MAIN_OUTPUT;
        break;
    case SETTINGS_PWM_AND_SIGN:
        set_pin(GPIOA, PIN_PWM_2, steps > 0);
        *TIM_CCR1(TIM1) = size;
        *TIM_BDTR(TIM1) |= TIM_BDTR_MAIN_OUTPUT;
        break;
    case SETTINGS_DAC:
    case SETTINGS_OUTPUTS:
    default:
        *DAC_DHR12R1 = (uint32_t)(DAC_ZERO + steps);
        break;
    }
    set_pin(GPIOB, PIN_DRIVER, true);
}

uint32_t board_output_delay_us(void)
{
    return settings->output == SETTINGS_DAC ? 0U : 1000000U / settings->pwm_Hz;
}

void board_output_off(void)
{
    set_pin(GPIOB, PIN_DRIVER, false);
    if (settings->output == SETTINGS_DAC) {
        *DAC_DHR12R1 = DAC_ZERO;
    } else {
        *TIM_BDTR(TIM1) &= ~(uint32_t)TIM_BDTR_MAIN_OUTPUT;
        *TIM_CCR1(TIM1) = 0;
        *TIM_CCR2(TIM1) = 0;
    }
}

/* The variables may be lost: nothing here depends on them. The watchdog then resets, where it runs. */
_Noreturn void board_fault(void)
{
    cortex_m_interrupts_off();
    set_pin(GPIOB, PIN_DRIVER, false);
    *TIM_BDTR(TIM1) &= ~(uint32_t)TIM_BDTR_MAIN_OUTPUT;
    *DAC_DHR12R1 = DAC_ZERO;
    for (;;) {
    }
}
