/* board_real.c on a model of the chip's registers: what it writes is looked at, and what it waits for happens.
 *
 * A register is a word. Between two accesses the model does what the chip would: the crystal, the PLL and the switch of
 * the clock follow their bits, set and reset words move the pins, a sector is erased. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "../port/stm32f405/board.h"
#include "../port/stm32f405/boot_id.h"
#include "../port/stm32f405/encoder.h"
#include "../port/stm32f405/registers.h"
#include "../port/stm32f405/uart.h"
#include "cortex_m.h"
#include "hilbo_device_config.h"
#include "stm32f405_model.h"

enum { REGISTERS = 256, FLASH_WORDS = 2 * 32768, SECTOR_WORDS = 32768, MOST_CUT_WORDS = 16 };

static struct {
    uintptr_t address[REGISTERS];
    volatile uint32_t value[REGISTERS];
    size_t count;
    bool crystal_works;
    uint32_t pins[2]; /* that are driven high, of A and B */
    bool driver_has_been_on;
    unsigned erased[2];
    volatile uint32_t flash[FLASH_WORDS];
} chip;

static volatile uint32_t *word(uintptr_t address)
{
    for (size_t i = 0; i < chip.count; i++) {
        if (chip.address[i] == address) {
            return &chip.value[i];
        }
    }
    chip.address[chip.count] = address;
    return &chip.value[chip.count++];
}

static void follow_clock(void)
{
    volatile uint32_t *cr = word(0x40023800U);
    volatile uint32_t *cfgr = word(0x40023808U);
    *cr = (*cr & RCC_CR_HSEON) != 0U && chip.crystal_works ? *cr | RCC_CR_HSERDY : *cr & ~(uint32_t)RCC_CR_HSERDY;
    *cr = (*cr & RCC_CR_PLLON) != 0U && (*cr & RCC_CR_HSERDY) != 0U ? *cr | RCC_CR_PLLRDY : *cr & ~(uint32_t)RCC_CR_PLLRDY;
    *cfgr = (*cfgr & ~(uint32_t)RCC_CFGR_SWS) | (*cfgr & 3U) << 2;
}

static void follow_pins(void)
{
    for (unsigned port = 0; port < 2U; port++) {
        volatile uint32_t *bsrr = word(0x40020018U + 0x400U * port);
        chip.pins[port] = (chip.pins[port] & ~(*bsrr >> 16)) | (*bsrr & 0xFFFFU);
        *bsrr = 0;
    }
    chip.driver_has_been_on = chip.driver_has_been_on || (chip.pins[1] >> 12 & 1U) != 0U;
}

static void follow_flash(void)
{
    volatile uint32_t *cr = word(0x40023C10U);
    *word(0x40023C0CU) = 0; /* no error, and what is written to this register clears it */
    if ((*cr & FLASH_CR_START) != 0U && (*cr & FLASH_CR_ERASE_SECTOR) != 0U) {
        const uint32_t sector = (*cr >> FLASH_CR_SECTOR_AT & 15U) - 10U;
        memset((uint32_t *)(uintptr_t)(chip.flash + sector * SECTOR_WORDS), 0xFF, 4U * SECTOR_WORDS);
        chip.erased[sector]++;
        *cr &= ~(uint32_t)FLASH_CR_START;
    }
}

static void follow(void)
{
    follow_clock();
    follow_pins();
    follow_flash();
}

static uintptr_t flash_offset(uintptr_t address)
{
    const uintptr_t in_memory = (uintptr_t)chip.flash;
    return address >= in_memory && address < in_memory + sizeof chip.flash ? address - in_memory : address - 0x080C0000U;
}

volatile uint32_t *register_at(uintptr_t address)
{
    follow();
    const uintptr_t offset = flash_offset(address);
    return offset < sizeof chip.flash ? &chip.flash[offset / 4U] : word(address);
}

void cortex_m_barrier(void)
{
}

void cortex_m_wait(void)
{
}

void cortex_m_interrupts_off(void)
{
}

void cortex_m_interrupts_on(void)
{
}

void systick_interrupt(void)
{
}

/* From here on: what the tests call. */

void model_reset(int crystal_works)
{
    memset(&chip, 0, sizeof chip);
    memset((uint32_t *)(uintptr_t)chip.flash, 0xFF, sizeof chip.flash);
    chip.crystal_works = crystal_works != 0;
    *word(0x40011000U) = USART_SR_ROOM;
}

uint32_t model_read(uint32_t address)
{
    return *register_at(address);
}

void model_write(uint32_t address, uint32_t value)
{
    *register_at(address) = value;
    follow();
}

uint32_t model_pins(int port)
{
    follow();
    return chip.pins[port];
}

int model_driver_has_been_on(void)
{
    follow();
    return chip.driver_has_been_on ? 1 : 0;
}

const char *model_start(int output, int motor_sign, uint32_t crystal_Hz, uint32_t pwm_Hz, float full_scale_N)
{
    static struct settings settings;
    settings = HILBO_SETTINGS;
    settings.output = (enum settings_output)output;
    settings.motor_sign = (int8_t)motor_sign;
    settings.crystal_Hz = crystal_Hz;
    settings.pwm_Hz = pwm_Hz;
    settings.full_scale_N = full_scale_N;
    return board_start(&settings, &HILBO_DEVICE_CONFIG);
}

uint32_t model_boot_id(void)
{
    return board_boot_id();
}

unsigned model_erased(int sector)
{
    return chip.erased[sector];
}

void model_output(float force_N)
{
    board_output(force_N);
}

void model_output_off(void)
{
    board_output_off();
}

uint32_t model_output_delay_us(void)
{
    return board_output_delay_us();
}

void model_start_ticks(uint32_t rate_Hz)
{
    board_start_watchdog(1000000U / rate_Hz);
    board_start_ticks(rate_Hz);
}

void model_tick_is_over(void)
{
    board_tick_is_over(0);
}

int model_stop_is_open(void)
{
    return board_stop_is_open() ? 1 : 0;
}

void model_send(const uint8_t *bytes, size_t size)
{
    uart_send(bytes, size);
}

void model_line_interrupt(void)
{
    usart1_interrupt();
}

int model_receive(void)
{
    uint8_t byte = 0;
    return uart_receive(&byte) ? (int)byte : -1;
}

int32_t model_encoder(const uint16_t *counters, size_t count)
{
    struct encoder encoder = {counters[0], 0};
    for (size_t i = 0; i < count; i++) {
        (void)encoder_extend(&encoder, counters[i]);
    }
    return encoder.counts;
}

int model_config_error(void)
{
    return (int)hb_config_check(&HILBO_DEVICE_CONFIG);
}

/* Flash of a few words, whose supply fails in the operation `cut`: that leaves a word, or a sector, half done. */
static struct {
    volatile uint32_t word[2][MOST_CUT_WORDS];
    uint32_t words;
    int left;
} small;

static bool is_cut(void)
{
    return small.left-- == 0;
}

static bool small_erase(unsigned sector)
{
    const bool cut = is_cut();
    for (uint32_t i = 0; i < small.words && small.left >= -1; i++) {
        small.word[sector][i] = cut && i % 3U == 0U ? small.word[sector][i] | 0xFF0000FFU : UINT32_C(0xFFFFFFFF);
    }
    return !cut;
}

static bool small_program(const volatile uint32_t *where, uint32_t value)
{
    const bool cut = is_cut();
    volatile uint32_t *cell = (volatile uint32_t *)(uintptr_t)where;
    *cell &= cut ? value | 0xFFFF0000U : value; /* flash only clears bits */
    return !cut && *cell == value;
}

void model_small_flash(uint32_t words)
{
    memset((uint32_t *)(uintptr_t)small.word, 0xFF, sizeof small.word);
    small.words = words;
}

/* The next boot id; `cut` < 0: the supply holds. */
uint32_t model_small_boot(int cut)
{
    const struct boot_flash flash = {{small.word[0], small.word[1]}, small.words, small_erase, small_program};
    small.left = cut < 0 ? 1000000 : cut;
    return boot_id_next(&flash);
}
