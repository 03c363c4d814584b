/* Telemetry packets, as docs/packets.md draws them: PUS-C in CCSDS space packets, big-endian.
 *
 *    0  u16  version 000, type 0, secondary header 1, APID (11 bits)
 *    2  u16  sequence flags 11, sequence count (14 bits)
 *    4  u16  octets that follow, less one
 *    6  u8   PUS version 2 (4 bits), time status
 *    7  u8   service       8  u8  subtype
 *    9  u16  count of messages of this type       11  u16  destination
 *   13  u32  seconds      17  u24  fraction, 2^-24 s
 *   20  ...  data
 *       u16  CRC-16 of all before it */
#include "evstim.h"

enum { HEADER_BYTES = 20, CRC_BYTES = 2, PRIMARY_BYTES = 6 };
enum { APID_BITS = 0x7FF, IDLE = 0x7FF, COUNT_BITS = 0x3FFF, HALF_COUNTS = 0x2000 };
enum { SCIENCE_SERVICE = 128, EVENTS = 129, EDGES = 130 };

static uint16_t u16(const uint8_t *p)
{
    return (uint16_t)(p[0] << 8 | p[1]);
}

/* CUC, 4 + 3 octets, to the nearest microsecond. */
static uint64_t cuc_us(const uint8_t *p)
{
    uint32_t seconds = (uint32_t)u16(p) << 16 | u16(p + 2), fraction = (uint32_t)p[4] << 16 | u16(p + 5);
    return (uint64_t)seconds * 1000000u + (((uint64_t)fraction * 1000000u + (1u << 23)) >> 24);
}

void evstim_telemetry_init(struct evstim_telemetry *telemetry, enum evstim_framing framing, uint8_t *buffer,
                           size_t capacity, uint16_t width, uint16_t height, const struct evstim_sink *sink)
{
    *telemetry = (struct evstim_telemetry){.framing = framing, .apid = EVSTIM_APID, .science_apid = EVSTIM_SCIENCE_APID};
    evstim_deframer_init(&telemetry->frames, buffer, capacity);
    evstim_blocks_init(&telemetry->blocks, width, height, sink);
}

/* A number less than half a turn ahead means that those between are missing; one behind is a repeat or a restart. */
static void follow(struct evstim_telemetry *t, uint16_t count)
{
    uint16_t ahead = (uint16_t)((count - t->expected) & COUNT_BITS);
    if (t->followed && ahead >= HALF_COUNTS)
        t->disordered++;
    else if (t->followed)
        t->missing += ahead;
    t->followed = true;
    t->expected = (uint16_t)((count + 1) & COUNT_BITS);
}

static bool is_sound(const uint8_t *packet, size_t n)
{
    return n >= HEADER_BYTES + CRC_BYTES && u16(packet + 4) + 1u == n - PRIMARY_BYTES
           && (packet[0] & 0xF8u) == 0x08u /* version 0, telemetry, secondary header */
           && packet[2] >> 6 == 3 && packet[6] >> 4 == 2 && evstim_crc16(EVSTIM_CRC16_START, packet, n) == 0;
}

static bool is_idle(const uint8_t *packet, size_t n)
{
    return n > PRIMARY_BYTES && packet[0] >> 5 == 0 && (u16(packet) & APID_BITS) == IDLE
           && u16(packet + 4) + 1u == n - PRIMARY_BYTES;
}

static void science(struct evstim_telemetry *t, const struct evstim_report *report, uint16_t count)
{
    follow(t, count);
    t->packets++;
    evstim_block(&t->blocks, report->data, report->length, report->t_us);
}

bool evstim_telemetry_packet(struct evstim_telemetry *t, const uint8_t *packet, size_t n)
{
    if (is_idle(packet, n)) {
        t->others++;
        return true;
    }
    if (!is_sound(packet, n)) {
        t->refused++;
        return false;
    }
    struct evstim_report report = {
        .t_us = cuc_us(packet + 13),
        .service = packet[7],
        .subtype = packet[8],
        .data = packet + HEADER_BYTES,
        .length = n - HEADER_BYTES - CRC_BYTES,
    };
    uint16_t apid = u16(packet) & APID_BITS;
    bool is_science = report.service == SCIENCE_SERVICE && (report.subtype == EVENTS || report.subtype == EDGES);
    if (apid == t->science_apid && is_science) {
        science(t, &report, u16(packet + 2) & COUNT_BITS);
    } else if (apid == t->apid) {
        t->others++;
        if (t->blocks.sink->report != NULL)
            t->blocks.sink->report(t->blocks.sink->context, &report);
    } else {
        t->refused++;
        return false;
    }
    return true;
}

void evstim_telemetry_push(struct evstim_telemetry *t, const uint8_t *bytes, size_t n)
{
    for (size_t i = 0; i < n; i++) {
        size_t length = t->framing == EVSTIM_COBS ? evstim_cobs_byte(&t->frames, bytes[i])
                                                  : evstim_slip_byte(&t->frames, bytes[i]);
        if (length != 0)
            evstim_telemetry_packet(t, t->frames.buffer, length);
    }
}
