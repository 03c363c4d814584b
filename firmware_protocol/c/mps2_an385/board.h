/* The part of the ARM MPS2 board with a Cortex-M3 (application note AN385) that this firmware uses, as in
 * qemu-system-arm -M mps2-an385. Registers: ARM DDI 0479D (Cortex-M System Design Kit), sections 4.2 (timer) and
 * 4.3 (UART). */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stdint.h>

struct uart {
    volatile uint32_t data, state, control, interrupt, divider;
};

struct timer {
    volatile uint32_t control, value, reload, interrupt;
};

#define TIMER ((struct timer *)0x40000000u)     /* counts down at 25 MHz */
#define HEARTBEAT ((struct timer *)0x40001000u) /* a second timer */
#define LINE ((struct uart *)0x40004000u)       /* UART 0: the serial line with the events */
#define CONSOLE ((struct uart *)0x40005000u)    /* UART 1: commands and reports */

enum { UART_TX_FULL = 1, UART_RX_FULL = 2, UART_TX_RX_ENABLE = 3, UART_DIVIDER = 16, TIMER_ENABLE = 1 };
enum { HEARTBEAT_TICKS = 2500000 }; /* 0.1 s */

static inline void board_init(void)
{
    LINE->divider = CONSOLE->divider = UART_DIVIDER;
    LINE->control = CONSOLE->control = UART_TX_RX_ENABLE;
    TIMER->value = TIMER->reload = UINT32_MAX;
    TIMER->control = TIMER_ENABLE;
    /* QEMU looks whether a UART can take bytes only when something wakes it; bytes that came before the UARTs were
     * enabled would wait for ever. A timer that goes off wakes it. */
    HEARTBEAT->reload = HEARTBEAT->value = HEARTBEAT_TICKS;
    HEARTBEAT->control = TIMER_ENABLE;
}

static inline bool uart_has_byte(const struct uart *uart)
{
    return uart->state & UART_RX_FULL;
}

static inline uint8_t uart_read(const struct uart *uart)
{
    return (uint8_t)uart->data;
}

static inline void uart_write(struct uart *uart, char character)
{
    while (uart->state & UART_TX_FULL) {
    }
    uart->data = (uint8_t)character;
}

static inline uint32_t ticks_now(void)
{
    return ~TIMER->value;
}

#endif
