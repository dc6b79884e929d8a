/* The registers of an STM32F405 that this port uses, by the reference manual RM0090; the names are the manual's. */
#ifndef REGISTERS_H
#define REGISTERS_H

#include "register.h"

#define RCC_CR register_at(0x40023800U)
#define RCC_PLLCFGR register_at(0x40023804U)
#define RCC_CFGR register_at(0x40023808U)
#define RCC_AHB1ENR register_at(0x40023830U)
#define RCC_APB1ENR register_at(0x40023840U)
#define RCC_APB2ENR register_at(0x40023844U)

enum {
    RCC_CR_HSEON = 1 << 16,
    RCC_CR_HSERDY = 1 << 17,
    RCC_CR_CSSON = 1 << 19, /* NMI when the crystal fails */
    RCC_CR_PLLON = 1 << 24,
    RCC_CR_PLLRDY = 1 << 25,
    RCC_PLLCFGR_FROM_HSE = 1 << 22,
    RCC_CFGR_SW_PLL = 2,
    RCC_CFGR_SWS = 3 << 2,
    RCC_CFGR_SWS_PLL = 2 << 2,
    RCC_CFGR_APB1_BY_4 = 5 << 10,
    RCC_CFGR_APB2_BY_2 = 4 << 13,
    RCC_AHB1_GPIOA = 1 << 0,
    RCC_AHB1_GPIOB = 1 << 1,
    RCC_APB1_TIM2 = 1 << 0,
    RCC_APB1_TIM3 = 1 << 1,
    RCC_APB1_TIM5 = 1 << 3,
    RCC_APB1_USART2 = 1 << 17,
    RCC_APB1_PWR = 1 << 28,
    RCC_APB1_DAC = 1 << 29,
    RCC_APB2_TIM1 = 1 << 0,
    RCC_APB2_USART1 = 1 << 4,
};

#define PWR_CR register_at(0x40007000U)

enum { PWR_CR_VOS = 1 << 14 }; /* the core's voltage that 168 MHz needs */

#define FLASH_ACR register_at(0x40023C00U)
#define FLASH_KEYR register_at(0x40023C04U)
#define FLASH_SR register_at(0x40023C0CU)
#define FLASH_CR register_at(0x40023C10U)

enum {
    FLASH_ACR_5_WAIT_STATES = 5,
    FLASH_ACR_PREFETCH = 1 << 8,
    FLASH_ACR_INSTRUCTION_CACHE = 1 << 9,
    FLASH_ACR_DATA_CACHE = 1 << 10,
    FLASH_ACR_DATA_CACHE_RESET = 1 << 12,
    FLASH_SR_ERRORS = 0xF2, /* PGSERR, PGPERR, PGAERR, WRPERR, OPERR; cleared by writing them */
    FLASH_SR_BUSY = 1 << 16,
    FLASH_CR_PROGRAM = 1 << 0,
    FLASH_CR_ERASE_SECTOR = 1 << 1,
    FLASH_CR_SECTOR_AT = 3,
    FLASH_CR_BY_WORDS = 2 << 8,
    FLASH_CR_START = 1 << 16,
};
#define FLASH_CR_LOCK (UINT32_C(1) << 31)
#define FLASH_KEY_1 UINT32_C(0x45670123)
#define FLASH_KEY_2 UINT32_C(0xCDEF89AB)

/* Ports and their pins. */
enum { GPIOA = 0x40020000, GPIOB = 0x40020400 };
#define GPIO_MODER(port) register_at((uintptr_t)(port))
#define GPIO_PUPDR(port) register_at((uintptr_t)(port) + 0x0CU)
#define GPIO_IDR(port) register_at((uintptr_t)(port) + 0x10U)
#define GPIO_BSRR(port) register_at((uintptr_t)(port) + 0x18U)
#define GPIO_AFR(port, pin) register_at((uintptr_t)(port) + 0x20U + 4U * ((pin) / 8U))

enum gpio_mode { GPIO_INPUT = 0, GPIO_OUTPUT = 1, GPIO_ALTERNATE = 2, GPIO_ANALOG = 3 };
enum gpio_pull { GPIO_NO_PULL = 0, GPIO_PULL_UP = 1, GPIO_PULL_DOWN = 2 };

enum { TIM1 = 0x40010000, TIM2 = 0x40000000, TIM3 = 0x40000400, TIM5 = 0x40000C00 };
#define TIM_CR1(timer) register_at((uintptr_t)(timer))
#define TIM_SMCR(timer) register_at((uintptr_t)(timer) + 0x08U)
#define TIM_EGR(timer) register_at((uintptr_t)(timer) + 0x14U)
#define TIM_CCMR1(timer) register_at((uintptr_t)(timer) + 0x18U)
#define TIM_CCER(timer) register_at((uintptr_t)(timer) + 0x20U)
#define TIM_CNT(timer) register_at((uintptr_t)(timer) + 0x24U)
#define TIM_PSC(timer) register_at((uintptr_t)(timer) + 0x28U)
#define TIM_ARR(timer) register_at((uintptr_t)(timer) + 0x2CU)
#define TIM_CCR1(timer) register_at((uintptr_t)(timer) + 0x34U)
#define TIM_CCR2(timer) register_at((uintptr_t)(timer) + 0x38U)
#define TIM_BDTR(timer) register_at((uintptr_t)(timer) + 0x44U)

enum {
    TIM_CR1_ON = 1 << 0,
    TIM_CR1_PRELOAD = 1 << 7,
    TIM_SMCR_ENCODER_OF_BOTH = 3,
    TIM_EGR_UPDATE = 1,
    TIM_CCMR1_INPUTS_DIRECT = 1 | 1 << 8,
    TIM_CCMR1_FILTER_OF_8 = 3 << 4 | 3 << 12,     /* 8 samples of the timer's clock: pulses below 95 ns are ignored */
    TIM_CCMR1_PWM_PRELOADED = 0x68 | 0x68 << 8,   /* mode 1 of channels 1 and 2, duty taken over at a period's end */
    TIM_CCER_BOTH = 1 | 1 << 4,
    TIM_BDTR_IDLE_DRIVEN = 1 << 10 | 1 << 11,     /* low, not floating, while the main output is off */
    TIM_BDTR_BREAK = 1 << 12,
    TIM_BDTR_BREAK_HIGH = 1 << 13,
    TIM_BDTR_MAIN_OUTPUT = 1 << 15,
};

enum { USART1 = 0x40011000, USART2 = 0x40004400, USART1_INTERRUPT = 37 };
#define USART_SR(usart) register_at((uintptr_t)(usart))
#define USART_DR(usart) register_at((uintptr_t)(usart) + 0x04U)
#define USART_BRR(usart) register_at((uintptr_t)(usart) + 0x08U)
#define USART_CR1(usart) register_at((uintptr_t)(usart) + 0x0CU)

enum {
    USART_SR_OVERRUN = 1 << 3,
    USART_SR_RECEIVED = 1 << 5,
    USART_SR_ROOM = 1 << 7,
    USART_CR1_RECEIVE = 1 << 2,
    USART_CR1_SEND = 1 << 3,
    USART_CR1_RECEIVED_INTERRUPTS = 1 << 5,
    USART_CR1_ROOM_INTERRUPTS = 1 << 7,
    USART_CR1_ON = 1 << 13,
};

#define DAC_CR register_at(0x40007400U)
#define DAC_DHR12R1 register_at(0x40007408U)

enum { DAC_CR_CHANNEL_1 = 1 };

#define IWDG_KR register_at(0x40003000U)
#define IWDG_PR register_at(0x40003004U)
#define IWDG_RLR register_at(0x40003008U)
#define IWDG_SR register_at(0x4000300CU)

enum { IWDG_KEY_UNLOCK = 0x5555, IWDG_KEY_FEED = 0xAAAA, IWDG_KEY_START = 0xCCCC };

#endif
