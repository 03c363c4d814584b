/* Times without their upper bits. For the library itself. */
#ifndef EVSTIM_TIME_H
#define EVSTIM_TIME_H

#include <stdint.h>

/* The number nearest to `expected` whose `bits` (at most 32) lowest bits are `low`, not below zero. */
static inline uint64_t evstim_unwrapped(uint32_t low, unsigned bits, uint64_t expected)
{
    uint64_t span = UINT64_C(1) << bits;
    uint64_t next = expected + ((low - expected) & (span - 1));
    return next - expected < span / 2 || next < span ? next : next - span;
}

#endif
