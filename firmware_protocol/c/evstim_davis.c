/* The 16-bit little-endian words of a DAVIS346's data endpoint.
 *
 *   bits 15..12  meaning                                    bits 11..0
 *   1xxx         timestamp                                  low 15 bits: microseconds since the last wrap
 *   0000         special                                    code
 *   0001         row (Y), in force until the next one       address
 *   0010         column (X), OFF: an event                  address
 *   0011         column (X), ON: an event                   address
 *   0100         APS sample                                 ADC value
 *   0101         misc, 8 bits of data                       code 11..8, data 7..0
 *   0110         misc, 10 bits of data                      code 11..10, data 9..0
 *   0111         timestamp wrap                             number of steps of 32768 us
 *
 * The meaning is that of libcaer 3.3.15 (davis.c): a wrap sets the time too; a row outside the array leaves the
 * previous one in force; a column outside is no event; a column before any row is in row 0; a time that does not
 * increase is counted and used. */
#include "evstim.h"

enum { SPECIAL, ROW, COLUMN_OFF, COLUMN_ON, APS_SAMPLE, MISC8, MISC10, WRAP };
enum { TIMESTAMP = 0x8000, WRAP_BITS = 15, LAST_MISC8_CODE = 3 };
enum { RESET = 1, INPUT_FALLING = 2, INPUT_RISING = 3, INPUT_PULSE = 4, OLD_IMU = 6, LAST_SPECIAL = 17 };

void evstim_davis_init(struct evstim_davis *davis, uint16_t width, uint16_t height, bool turned,
                       const struct evstim_sink *sink)
{
    *davis = (struct evstim_davis){
        .sink = sink,
        .columns = turned ? height : width,
        .rows = turned ? width : height,
        .turned = turned,
    };
}

static void move_time(struct evstim_davis *d, uint64_t time_us)
{
    d->time_not_increasing += time_us <= d->time_us;
    d->time_us = time_us;
}

static void edge(struct evstim_davis *d, enum evstim_edge_kind kind)
{
    struct evstim_edge edge = {.t_us = d->time_us, .kind = (uint8_t)kind};
    d->edges++;
    if (d->sink->edge != NULL)
        d->sink->edge(d->sink->context, &edge);
}

static void special(struct evstim_davis *d, unsigned code)
{
    switch (code) {
    case RESET:
        d->wrap_us = 0;
        d->time_us = 0;
        d->resets++;
        break;
    case INPUT_FALLING:
        edge(d, EVSTIM_FALLING);
        break;
    case INPUT_RISING:
        edge(d, EVSTIM_RISING);
        break;
    case INPUT_PULSE:
        edge(d, EVSTIM_PULSE);
        break;
    default:
        if (code == 0 || code == OLD_IMU || code > LAST_SPECIAL)
            d->unknown_special++;
    }
}

static void column(struct evstim_davis *d, uint16_t address, bool on)
{
    if (address >= d->columns) {
        d->column_outside++;
        return;
    }
    struct evstim_event event = {
        .t_us = d->time_us,
        .x = d->turned ? d->row : address,
        .y = d->turned ? address : d->row,
        .on = on,
    };
    d->events++;
    if (d->sink->event != NULL)
        d->sink->event(d->sink->context, &event);
}

static void not_interpreted(struct evstim_davis *d, bool known)
{
    if (known)
        d->not_interpreted++;
    else
        d->unknown_misc++;
}

void evstim_davis_word(struct evstim_davis *d, uint16_t word)
{
    uint16_t data = word & 0xFFFu;
    if (word & TIMESTAMP) {
        move_time(d, d->wrap_us + (word & 0x7FFFu));
        return;
    }
    switch (word >> 12) {
    case SPECIAL:
        special(d, data);
        break;
    case ROW:
        if (data < d->rows)
            d->row = data;
        else
            d->row_outside++;
        break;
    case COLUMN_OFF:
    case COLUMN_ON:
        column(d, data, word >> 12 == COLUMN_ON);
        break;
    case MISC8:
        not_interpreted(d, data >> 8 <= LAST_MISC8_CODE);
        break;
    case MISC10:
        not_interpreted(d, data >> 10 == 0);
        break;
    case WRAP:
        d->wrap_us += (uint64_t)data << WRAP_BITS;
        move_time(d, d->wrap_us);
        break;
    default: /* APS_SAMPLE */
        d->not_interpreted++;
    }
}

void evstim_davis_push(struct evstim_davis *d, const uint8_t *bytes, size_t n)
{
    for (size_t i = 0; i < n; i++) {
        if (d->half)
            evstim_davis_word(d, (uint16_t)(d->low_byte | bytes[i] << 8));
        else
            d->low_byte = bytes[i];
        d->half = !d->half;
    }
}
