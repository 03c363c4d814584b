/* ISO-TP (ISO 15765-2), the receiving side, normal addressing.
 *
 *   single       0L data                L = 1..7; more than 8 bytes: 00 LL data
 *   first        1L LL data             12 bits of length; above 4095: 10 00 and a big-endian u32
 *   consecutive  2n data                n counts 1..15, 0, 1 ... from the first frame on
 *   flow control 3s BS STmin            s: 0 continue, 2 overflow
 *
 * Frames are padded with 0xCC. */
#include "evstim.h"

enum { SINGLE, FIRST, CONSECUTIVE, FLOW_CONTROL };
enum { GO_ON = 0, OVERFLOW = 2, PADDING = 0xCC, LENGTH_BITS = 0xFFF, SERIAL_BITS = 15, CLASSIC_BYTES = 8 };

void evstim_isotp_init(struct evstim_isotp *isotp, uint8_t *buffer, size_t capacity)
{
    *isotp = (struct evstim_isotp){.buffer = buffer, .capacity = capacity};
}

static void answer(struct evstim_isotp *s, unsigned status)
{
    for (unsigned i = 3; i < sizeof s->reply; i++)
        s->reply[i] = PADDING;
    s->reply[0] = (uint8_t)(FLOW_CONTROL << 4 | status);
    s->reply[1] = s->block_size;
    s->reply[2] = s->separation;
    s->has_reply = true;
}

/* Store the part of `n` bytes that the message still needs. */
static void keep(struct evstim_isotp *s, const uint8_t *bytes, size_t n)
{
    for (size_t i = 0; i < n && s->at < s->length; i++)
        s->buffer[s->at++] = bytes[i];
}

/* Begin a message: an open one is given up. */
static void begin(struct evstim_isotp *s)
{
    if (s->length != 0)
        s->cut_short++;
    s->length = 0;
    s->at = 0;
}

static size_t end(struct evstim_isotp *s)
{
    size_t length = s->length;
    s->length = 0;
    s->messages++;
    return length;
}

static size_t single(struct evstim_isotp *s, const uint8_t *data, size_t n)
{
    size_t length = data[0] & 15u, head = 1;
    if (length == 0 && n > CLASSIC_BYTES) {
        length = data[1];
        head = 2;
    }
    begin(s);
    if (length == 0 || length > n - head) {
        s->malformed++;
        return 0;
    }
    if (length > s->capacity) {
        s->too_long++;
        return 0;
    }
    s->length = length;
    keep(s, data + head, length);
    return end(s);
}

static void first(struct evstim_isotp *s, const uint8_t *data, size_t n)
{
    begin(s);
    if (n < CLASSIC_BYTES) {
        s->malformed++;
        return;
    }
    uint32_t length = ((uint32_t)data[0] << 8 | data[1]) & LENGTH_BITS;
    size_t head = 2;
    if (length == 0) {
        length = (uint32_t)data[2] << 24 | (uint32_t)data[3] << 16 | (uint32_t)data[4] << 8 | data[5];
        head = 6;
    }
    if (length <= n - head) {
        s->malformed++;
    } else if (length > s->capacity) {
        s->too_long++;
        answer(s, OVERFLOW);
    } else {
        s->length = length;
        s->serial = 0;
        s->in_block = 0;
        keep(s, data + head, n - head);
        answer(s, GO_ON);
    }
}

static size_t consecutive(struct evstim_isotp *s, const uint8_t *data, size_t n)
{
    if (s->length == 0) {
        s->without_beginning++;
        return 0;
    }
    s->serial = (s->serial + 1u) & SERIAL_BITS;
    if ((data[0] & SERIAL_BITS) != s->serial) {
        s->disordered++;
        s->length = 0;
        return 0;
    }
    keep(s, data + 1, n - 1);
    if (s->at == s->length)
        return end(s);
    s->in_block++;
    if (s->block_size != 0 && s->in_block == s->block_size) {
        s->in_block = 0;
        answer(s, GO_ON);
    }
    return 0;
}

size_t evstim_isotp_frame(struct evstim_isotp *s, const uint8_t *data, size_t n)
{
    s->has_reply = false;
    if (n == 0)
        return 0;
    switch (data[0] >> 4) {
    case SINGLE:
        return single(s, data, n);
    case FIRST:
        first(s, data, n);
        return 0;
    case CONSECUTIVE:
        return consecutive(s, data, n);
    default: /* flow control is for the sender of telecommands */
        return 0;
    }
}
