/* A peripheral's register by its address. The tests give one of their own, to look at what is written. */
#ifndef ARM_REGISTER_H
#define ARM_REGISTER_H

#include <stdint.h>

#if defined(REGISTER_MODEL)
volatile uint32_t *register_at(uintptr_t address);
#else
static inline volatile uint32_t *register_at(uintptr_t address)
{
    return (volatile uint32_t *)address;
}
#endif

#endif
