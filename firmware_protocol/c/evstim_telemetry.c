/* Telemetry packets, in the layout of docs/packets.md, big-endian. PUS-C in CCSDS space packets:
 *
 *    0  u16  version 000, type 0, secondary header 1, APID (11 bits)
 *    2  u16  sequence flags 11, sequence count (14 bits)
 *    4  u16  octets that follow, less one
 *    6  u8   PUS version 2 (4 bits), time status
 *    7  u8   service       8  u8  subtype
 *    9  u16  count of messages of this type       11  u16  destination
 *   13  u32  seconds      17  u24  fraction, 2^-24 s
 *   20  ...  data
 *       u16  CRC-16 of all before it
 *
 * CSP version 2:
 *
 *    0  u48  priority (2 bits), destination 14, source 14, destination port 6, source port 6, flags 6
 *    6  u16  count of the packets to this port
 *    8  u32  seconds      12  u24  fraction, 2^-24 s
 *   15  ...  data */
#include "evstim.h"

enum { HEADER_BYTES = 20, CRC_BYTES = 2, PRIMARY_BYTES = 6 };
enum { APID_BITS = 0x7FF, IDLE = 0x7FF, COUNT_BITS = 0x3FFF };
enum { SCIENCE_SERVICE = 128, EVENTS = 129, EDGES = 130 };
enum { CSP_COUNT_AT = 6, CSP_TIME_AT = 8, CSP_DATA_AT = 15, CSP_COUNT_BITS = 0xFFFF };
enum { PORT_EVENTS = 9, PORT_EDGES, PORT_HOUSEKEEPING, PORT_VERIFICATION, PORT_TIME, PORT_PONG };

/* Service and subtype of the ports from PORT_HOUSEKEEPING on; a verification's subtype is the first octet of its data. */
static const uint8_t csp_types[][2] = {{3, 25}, {1, 0}, {9, 2}, {17, 2}};

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
    *telemetry = (struct evstim_telemetry){
        .framing = framing,
        .apid = EVSTIM_APID,
        .science_apid = EVSTIM_SCIENCE_APID,
        .csp_node = EVSTIM_CSP_NODE,
        .csp_peer = EVSTIM_CSP_PEER,
    };
    evstim_deframer_init(&telemetry->frames, buffer, capacity);
    evstim_blocks_init(&telemetry->blocks, width, height, sink);
}

/* A count less than half the modulus ahead means that the packets between are missing; one behind is a repeat or a
 * restart. */
static void follow(struct evstim_telemetry *t, struct evstim_sequence *s, uint16_t count, uint16_t bits)
{
    uint16_t ahead = (uint16_t)((count - s->expected) & bits);
    if (s->followed && ahead > bits >> 1)
        t->disordered++;
    else if (s->followed)
        t->missing += ahead;
    s->followed = true;
    s->expected = (uint16_t)((count + 1) & bits);
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

static void science(struct evstim_telemetry *t, const struct evstim_report *report)
{
    t->packets++;
    evstim_block(&t->blocks, report->data, report->length, report->t_us);
}

static void other(struct evstim_telemetry *t, const struct evstim_report *report)
{
    t->others++;
    if (t->blocks.sink->report != NULL)
        t->blocks.sink->report(t->blocks.sink->context, report);
}

static bool refuse(struct evstim_telemetry *t)
{
    t->refused++;
    return false;
}

bool evstim_telemetry_packet(struct evstim_telemetry *t, const uint8_t *packet, size_t n)
{
    if (is_idle(packet, n)) {
        t->others++;
        return true;
    }
    if (!is_sound(packet, n))
        return refuse(t);
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
        follow(t, &t->sequences[0], u16(packet + 2) & COUNT_BITS, COUNT_BITS);
        science(t, &report);
    } else if (apid == t->apid) {
        other(t, &report);
    } else {
        return refuse(t);
    }
    return true;
}

static bool csp_answer(struct evstim_telemetry *t, struct evstim_report *report, unsigned port)
{
    report->service = csp_types[port - PORT_HOUSEKEEPING][0];
    report->subtype = csp_types[port - PORT_HOUSEKEEPING][1];
    if (port == PORT_VERIFICATION) {
        if (report->length == 0)
            return refuse(t);
        report->subtype = *report->data++;
        report->length--;
    }
    other(t, report);
    return true;
}

/* A CSP packet whose CRC-32C has been checked and left out. */
static bool csp(struct evstim_telemetry *t, const uint8_t *packet, size_t n)
{
    if (n < CSP_DATA_AT)
        return refuse(t);
    uint32_t low = (uint32_t)u16(packet + 2) << 16 | u16(packet + 4);
    unsigned destination = u16(packet) & 0x3FFFu, source = low >> 18, port = low >> 12 & 0x3Fu;
    if (destination != t->csp_peer || source != t->csp_node || port < PORT_EVENTS || port > PORT_PONG)
        return refuse(t);
    struct evstim_report report = {
        .t_us = cuc_us(packet + CSP_TIME_AT),
        .service = SCIENCE_SERVICE,
        .subtype = (uint8_t)(EVENTS + (port - PORT_EVENTS)),
        .data = packet + CSP_DATA_AT,
        .length = n - CSP_DATA_AT,
    };
    if (port > PORT_EDGES)
        return csp_answer(t, &report, port);
    follow(t, &t->sequences[port - PORT_EVENTS], u16(packet + CSP_COUNT_AT), CSP_COUNT_BITS);
    science(t, &report);
    return true;
}

bool evstim_telemetry_csp_packet(struct evstim_telemetry *t, const uint8_t *packet, size_t n)
{
    return csp(t, packet, evstim_sealed_length(packet, n));
}

static size_t deframe(struct evstim_telemetry *t, uint8_t byte)
{
    if (t->framing == EVSTIM_COBS)
        return evstim_cobs_byte(&t->frames, byte);
    if (t->framing == EVSTIM_SLIP)
        return evstim_slip_byte(&t->frames, byte);
    return evstim_kiss_byte(&t->frames, byte);
}

void evstim_telemetry_push(struct evstim_telemetry *t, const uint8_t *bytes, size_t n)
{
    for (size_t i = 0; i < n; i++) {
        size_t length = deframe(t, bytes[i]);
        if (length != 0 && t->framing == EVSTIM_CSP_KISS)
            csp(t, t->frames.buffer, length);
        else if (length != 0)
            evstim_telemetry_packet(t, t->frames.buffer, length);
    }
}
