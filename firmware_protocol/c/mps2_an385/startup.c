/* From reset to main: the vector table, the memory as C expects it, and the two functions that a compiler may call
 * by itself even without a library. */
#include <stddef.h>
#include <stdint.h>

extern uint32_t stack_top, data_start, data_end, data_in_flash, bss_start, bss_end; /* from board.ld */

int main(void);
void reset(void);

void *memset(void *to, int value, size_t n)
{
    volatile uint8_t *at = to; /* volatile: or the compiler would make this loop a call of memset */
    while (n-- > 0)
        *at++ = (uint8_t)value;
    return to;
}

void *memcpy(void *restrict to, const void *restrict from, size_t n)
{
    volatile uint8_t *at = to;
    const uint8_t *source = from;
    while (n-- > 0)
        *at++ = *source++;
    return to;
}

static void halt(void)
{
    for (;;) {
    }
}

void reset(void)
{
    memcpy(&data_start, &data_in_flash, (size_t)((uint8_t *)&data_end - (uint8_t *)&data_start));
    memset(&bss_start, 0, (size_t)((uint8_t *)&bss_end - (uint8_t *)&bss_start));
    main();
    halt();
}

/* Interrupts are not used, so the table ends with the faults. */
__attribute__((section(".vectors"), used)) static const struct {
    const uint32_t *stack;
    void (*reset)(void);
    void (*nmi_hard_memory_bus_usage[5])(void);
} vectors = {&stack_top, reset, {halt, halt, halt, halt, halt}};
