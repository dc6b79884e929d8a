/* What every ARMv7-M processor with a floating-point unit has: that unit, the system timer, interrupts, memory at reset. */
#ifndef ARM_CORTEX_M_H
#define ARM_CORTEX_M_H

#include <stdint.h>

#include "register.h"

#define CORTEX_M_VECTORS register_at(0xE000ED08U)
#define CORTEX_M_CPACR register_at(0xE000ED88U) /* coprocessor access */
#define CORTEX_M_SYSTICK_CONTROL register_at(0xE000E010U)
#define CORTEX_M_SYSTICK_RELOAD register_at(0xE000E014U)
#define CORTEX_M_SYSTICK_VALUE register_at(0xE000E018U)
#define CORTEX_M_PENDING register_at(0xE000ED04U)
#define CORTEX_M_PENDING_SYSTICK (UINT32_C(1) << 26)
#define CORTEX_M_NVIC_ENABLE(interrupt) register_at(0xE000E100U + 4U * ((interrupt) / 32U))

#if defined(__arm__)
static inline void cortex_m_barrier(void)
{
    __asm volatile("dsb\n isb" ::: "memory");
}

/* The processor waits for an interrupt; with interrupts off too, in which case it is served when they are on again. */
static inline void cortex_m_wait(void)
{
    __asm volatile("wfi" ::: "memory");
}

static inline void cortex_m_interrupts_off(void)
{
    __asm volatile("cpsid i" ::: "memory");
}

static inline void cortex_m_interrupts_on(void)
{
    __asm volatile("cpsie i" ::: "memory");
}
#else /* the register model of the tests */
void cortex_m_barrier(void);
void cortex_m_wait(void);
void cortex_m_interrupts_off(void);
void cortex_m_interrupts_on(void);
#endif

static inline void cortex_m_enable_fpu(void)
{
    *CORTEX_M_CPACR |= UINT32_C(0xF) << 20;
    cortex_m_barrier();
}

static inline void cortex_m_start_systick(uint32_t clock_Hz, uint32_t rate_Hz)
{
    *CORTEX_M_SYSTICK_RELOAD = clock_Hz / rate_Hz - 1U;
    *CORTEX_M_SYSTICK_VALUE = 0;
    *CORTEX_M_SYSTICK_CONTROL = 7; /* the processor's clock, with its interrupt, on */
}

static inline void cortex_m_enable_interrupt(uint32_t interrupt)
{
    *CORTEX_M_NVIC_ENABLE(interrupt) = UINT32_C(1) << interrupt % 32U;
}

/* The linker's addresses are no bounds of one array to the compiler, so that they are compared as numbers. */
static inline void cortex_m_copy(uint32_t *to, const uint32_t *end, const uint32_t *from)
{
    for (; (uintptr_t)to < (uintptr_t)end; to++, from++) {
        *to = *from;
    }
}

static inline void cortex_m_fill(uint32_t *to, const uint32_t *end, uint32_t value)
{
    for (; (uintptr_t)to < (uintptr_t)end; to++) {
        *to = value;
    }
}

#endif
