/* COBS, SLIP (RFC 1055) and KISS as libcsp has it, a byte at a time.
 *
 * COBS: a code byte c precedes c - 1 bytes without a zero, and represents a zero after them unless c is 0xFF or the
 * frame ends there; 0x00 ends the frame. SLIP: 0xC0 ends the frame; 0xDB 0xDC represents 0xC0, 0xDB 0xDD represents
 * 0xDB. KISS: SLIP with a byte 0x00 before the data and their big-endian CRC-32C after them.
 *
 * After any error, decoding restarts at the next delimiter. */
#include "evstim.h"

enum { COBS_END = 0x00, COBS_FULL = 0xFF, SLIP_END = 0xC0, SLIP_ESC = 0xDB, SLIP_ESC_END = 0xDC, SLIP_ESC_ESC = 0xDD };
enum { KISS_DATA = 0x00, CRC32_BYTES = 4 };

void evstim_deframer_init(struct evstim_deframer *deframer, uint8_t *buffer, size_t capacity)
{
    *deframer = (struct evstim_deframer){.buffer = buffer, .capacity = capacity};
}

static void append(struct evstim_deframer *d, uint8_t byte)
{
    if (d->length < d->capacity) {
        d->buffer[d->length++] = byte;
    } else if (!d->broken) {
        d->broken = true;
        d->too_long++;
    }
}

static void break_frame(struct evstim_deframer *d)
{
    if (!d->broken) {
        d->broken = true;
        d->malformed++;
    }
}

/* At a delimiter: return the length of the frame before it, 0 if there is none or it is broken. */
static size_t end_frame(struct evstim_deframer *d)
{
    if (d->left != 0)
        break_frame(d);
    size_t length = d->broken ? 0 : d->length;
    if (length != 0)
        d->frames++;
    d->length = 0;
    d->left = 0;
    d->code = 0;
    d->broken = false;
    return length;
}

size_t evstim_cobs_byte(struct evstim_deframer *d, uint8_t byte)
{
    if (byte == COBS_END)
        return end_frame(d);
    if (d->left != 0) {
        append(d, byte);
        d->left--;
        return 0;
    }
    if (d->code != 0 && d->code != COBS_FULL)
        append(d, 0);
    d->code = byte;
    d->left = (uint8_t)(byte - 1);
    return 0;
}

size_t evstim_slip_byte(struct evstim_deframer *d, uint8_t byte)
{
    if (byte == SLIP_END)
        return end_frame(d);
    if (d->left != 0) {
        d->left = 0;
        if (byte == SLIP_ESC_END)
            append(d, SLIP_END);
        else if (byte == SLIP_ESC_ESC)
            append(d, SLIP_ESC);
        else
            break_frame(d);
    } else if (byte == SLIP_ESC) {
        d->left = 1;
    } else {
        append(d, byte);
    }
    return 0;
}

size_t evstim_sealed_length(const uint8_t *bytes, size_t n)
{
    if (n < CRC32_BYTES)
        return 0;
    const uint8_t *p = bytes + n - CRC32_BYTES;
    uint32_t sent = (uint32_t)p[0] << 24 | (uint32_t)p[1] << 16 | (uint32_t)p[2] << 8 | p[3];
    return evstim_crc32c(0, bytes, n - CRC32_BYTES) == sent ? n - CRC32_BYTES : 0;
}

size_t evstim_kiss_byte(struct evstim_deframer *d, uint8_t byte)
{
    if (byte != SLIP_END && d->code == 0) {
        d->code = 1;
        if (byte != KISS_DATA)
            break_frame(d);
        return 0;
    }
    size_t length = evstim_slip_byte(d, byte);
    if (length == 0)
        return 0;
    size_t checked = evstim_sealed_length(d->buffer, length);
    if (checked == 0) {
        d->frames--;
        d->wrong_crc++;
    }
    return checked;
}
