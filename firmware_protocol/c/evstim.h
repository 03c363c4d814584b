/* evstim: events from a serial line, a CAN bus or a DAVIS346, for software that has no operating system.
 *
 * C99, freestanding: needs <stdint.h>, <stddef.h> and <stdbool.h>, and no library at all. No heap, no floating point,
 * no division, no recursion, no global state. The caller owns every struct and every buffer; the `_init` function of a
 * struct prepares it, and the caller then passes bytes, words or frames to it, in pieces of any size. Decoded data go
 * to the callbacks of a sink. No input can make the library read or write outside the memory it was given, and it
 * counts everything that it refuses.
 *
 * Nothing is delivered from a frame until the whole frame has been checked.
 */
#ifndef EVSTIM_H
#define EVSTIM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* ---- Decoded data ------------------------------------------------------------------------------------------------ */

/* A change of light at a pixel. x counts columns from the left, y rows from the top. */
struct evstim_event {
    uint64_t t_us; /* device time, microseconds */
    uint16_t x;
    uint16_t y;
    bool on; /* true: brighter, false: darker */
};

enum evstim_edge_kind { EVSTIM_RISING = 2, EVSTIM_FALLING = 3, EVSTIM_PULSE = 4 };

/* An edge on the camera's external input. */
struct evstim_edge {
    uint64_t t_us;
    uint8_t kind;    /* enum evstim_edge_kind */
    uint8_t channel; /* number of the input */
    uint16_t seq;    /* number of the edge at its source, 0 if the source counts none */
};

/* A packet of another service than events and edges: housekeeping (3, 25), verification (1, x), ... */
struct evstim_report {
    uint64_t t_us;
    uint8_t service, subtype;
    const uint8_t *data;
    size_t length;
};

/* Receiver of decoded data. The pointers are valid during the call only; any of the functions may be NULL. */
struct evstim_sink {
    void (*event)(void *context, const struct evstim_event *event);
    void (*edge)(void *context, const struct evstim_edge *edge);
    void (*mark)(void *context, const struct evstim_edge *mark); /* the camera's own trigger or exposure, on CAN */
    void (*report)(void *context, const struct evstim_report *report);
    void *context;
};

/* ---- Checksums --------------------------------------------------------------------------------------------------- */

#define EVSTIM_CRC16_START 0xFFFFu

/* CRC-16-CCITT-FALSE of `n` bytes that follow those with the CRC `crc` (polynomial 0x1021, not reflected).
 * "123456789" gives 0x29B1; a message followed by its own CRC, big-endian, gives 0. */
uint16_t evstim_crc16(uint16_t crc, const uint8_t *bytes, size_t n);

/* CRC-32C of `n` bytes that follow those with the CRC `crc`, 0 for none. "123456789" gives 0xE3069283. */
uint32_t evstim_crc32c(uint32_t crc, const uint8_t *bytes, size_t n);

/* The length of the data before a CRC-32C, big-endian, of all before it; 0 if the CRC is wrong. */
size_t evstim_sealed_length(const uint8_t *bytes, size_t n);

/* ---- Frames out of bytes: COBS, SLIP, KISS ----------------------------------------------------------------------- */

struct evstim_deframer {
    uint8_t *buffer;
    size_t capacity;
    size_t length; /* bytes of the frame so far */
    uint8_t left;  /* COBS: bytes until the next code byte. SLIP: 1 after an escape byte */
    uint8_t code;  /* COBS: the last code byte, 0 before the first. KISS: 1 after the command byte */
    bool broken;   /* this frame cannot become complete any more */
    uint32_t frames;    /* whole frames */
    uint32_t malformed; /* frames that violate their framing */
    uint32_t too_long;  /* frames that did not fit the buffer */
    uint32_t wrong_crc; /* KISS frames with a wrong CRC-32C */
};

/* Prepare. A frame may be as long as the buffer, without the framing but with KISS's CRC-32C. */
void evstim_deframer_init(struct evstim_deframer *deframer, uint8_t *buffer, size_t capacity);

/* Process one byte. Returns the length of the frame that this byte completed, which is at deframer->buffer until the
 * next call, or 0. Empty frames (runs of delimiters) are ignored. */
size_t evstim_cobs_byte(struct evstim_deframer *deframer, uint8_t byte);
size_t evstim_slip_byte(struct evstim_deframer *deframer, uint8_t byte);
size_t evstim_kiss_byte(struct evstim_deframer *deframer, uint8_t byte);

/* ---- Event blocks ------------------------------------------------------------------------------------------------ */

/* Reads the blocks of docs/packets.md, of one camera. */
struct evstim_blocks {
    const struct evstim_sink *sink;
    uint64_t last_us; /* time of the first event or edge of the last good block */
    uint32_t pixels;
    uint32_t per_pixels, per_width; /* reciprocals of pixels and width, times 2^32 */
    uint16_t width, height;
    uint8_t x_bits, y_bits;
    uint32_t blocks;     /* good ones */
    uint32_t refused;    /* malformed */
    uint32_t other_size; /* of another camera */
    uint32_t events;
    uint32_t edges;
    uint32_t dropped; /* events that the camera reports as dropped; at least, since a block reports 65535 at most */
};

/* Prepare for a camera of `width` x `height` pixels, each 1 to 4096. */
void evstim_blocks_init(struct evstim_blocks *blocks, uint16_t width, uint16_t height, const struct evstim_sink *sink);

/* Process one whole block, checked by the CRC of its packet. Blocks contain 32 bits of the time; the full time is the
 * one nearest to `near_us`: that of the packet, or blocks->last_us. Returns true if it is good; if not, none of its
 * content has been delivered. */
bool evstim_block(struct evstim_blocks *blocks, const uint8_t *bytes, size_t n, uint64_t near_us);

/* ---- Telemetry: packets on a serial line, or in the messages of ISO-TP and CFP ----------------------------------- */

/* Profiles ccsds-cobs, ccsds-slip, ccsds-kiss, csp-kiss. */
enum evstim_framing { EVSTIM_COBS, EVSTIM_SLIP, EVSTIM_KISS, EVSTIM_CSP_KISS };
enum { EVSTIM_APID = 0x2A0, EVSTIM_SCIENCE_APID = 0x2A1, EVSTIM_CSP_NODE = 10, EVSTIM_CSP_PEER = 1 };

/* The expected count of the next packet with a block. */
struct evstim_sequence {
    uint16_t expected;
    bool followed; /* there has been one */
};

/* Bytes -> frames -> packets -> blocks -> events. */
struct evstim_telemetry {
    struct evstim_deframer frames;
    struct evstim_blocks blocks;
    enum evstim_framing framing;
    uint16_t apid, science_apid; /* of the camera; may be changed after the init function */
    uint16_t csp_node, csp_peer; /* CSP addresses of the camera and of this computer; likewise */
    struct evstim_sequence sequences[2]; /* space packets; CSP: events, edges */
    uint32_t packets;    /* good ones with a block */
    uint32_t others;     /* good ones without: idle, and those handed to sink->report */
    uint32_t refused;    /* damaged, or not from this camera */
    uint32_t missing;    /* packets with a block that never arrived */
    uint32_t disordered; /* packets with a block whose count was behind: repeated, late, or the camera restarted */
};

/* Prepare. The buffer holds one packet: the longest block and 22 bytes, 26 with KISS; with the camera's default of
 * 1024 bytes for a block, 1046 or 1050. */
void evstim_telemetry_init(struct evstim_telemetry *telemetry, enum evstim_framing framing, uint8_t *buffer,
                           size_t capacity, uint16_t width, uint16_t height, const struct evstim_sink *sink);
void evstim_telemetry_push(struct evstim_telemetry *telemetry, const uint8_t *bytes, size_t n);

/* Process one whole packet, from a transport that preserves packet boundaries: profile ccsds (a space packet, as in an
 * ISO-TP message), profile csp (a CSP packet followed by its CRC-32C, as in CFP). The telemetry's buffer is not used.
 * Returns true if it is good. */
bool evstim_telemetry_packet(struct evstim_telemetry *telemetry, const uint8_t *packet, size_t n);
bool evstim_telemetry_csp_packet(struct evstim_telemetry *telemetry, const uint8_t *packet, size_t n);

/* ---- Messages in CAN frames: transports isotp and cfp ------------------------------------------------------------ */

/* Assembles the messages of one ISO-TP sender (ISO 15765-2, normal addressing, classic CAN and CAN FD). */
struct evstim_isotp {
    uint8_t *buffer;
    size_t capacity;
    size_t length, at;  /* of the present message, 0 for none; bytes received */
    uint8_t serial;     /* of the last frame */
    uint8_t in_block;   /* consecutive frames since the last flow control */
    uint8_t block_size; /* frames between flow controls to request, 0 for all; may be set after init */
    uint8_t separation; /* STmin to request: 0 to 127 ms; likewise */
    uint8_t reply[8];   /* flow control to send at once, if has_reply is true; ignore it without flow control */
    bool has_reply;     /* set by each frame */
    uint32_t messages;  /* whole ones */
    uint32_t malformed; /* frames that ISO-TP does not have */
    uint32_t too_long;  /* messages that the buffer cannot hold */
    uint32_t disordered;        /* messages given up: a frame was missing or repeated */
    uint32_t cut_short;         /* messages given up: another began */
    uint32_t without_beginning; /* frames without a first frame before them */
};

/* Prepare. The buffer holds one message; see evstim_telemetry_init for its size. */
void evstim_isotp_init(struct evstim_isotp *isotp, uint8_t *buffer, size_t capacity);

/* Process the data of one frame of the camera's identifier `telemetry`. Returns the length of the message that it
 * completed, which is in the buffer until the next call, or 0. There is no clock: a message whose end never arrives
 * stays open until the next one begins. */
size_t evstim_isotp_frame(struct evstim_isotp *isotp, const uint8_t *data, size_t n);

/* Assembles the CSP packets of one node (CFP 2, CSP version 2, classic CAN). */
struct evstim_cfp {
    uint8_t *buffer;
    size_t capacity;
    uint16_t node, peer; /* CSP addresses of the camera, of which six bits are compared, and of this computer */
    size_t length;       /* of the present packet, 0 for none */
    uint32_t connection; /* its priority and packet count */
    uint8_t next;        /* expected frame count */
    uint32_t packets;    /* whole ones; their CRC-32C is not checked yet */
    uint32_t malformed;  /* frames that CFP does not have */
    uint32_t too_long;   /* packets that the buffer cannot hold */
    uint32_t disordered;        /* packets given up: a frame was missing or repeated */
    uint32_t cut_short;         /* packets given up: another began */
    uint32_t without_beginning; /* frames without a first frame before them */
};

/* Prepare. The buffer holds one packet: the longest block and 19 bytes. */
void evstim_cfp_init(struct evstim_cfp *cfp, uint16_t node, uint16_t peer, uint8_t *buffer, size_t capacity);

/* Process one classic frame of an extended (29-bit) identifier; those of other nodes are ignored. Returns the length of
 * the packet that it completed, which is in the buffer until the next call, or 0. */
size_t evstim_cfp_frame(struct evstim_cfp *cfp, uint32_t identifier, const uint8_t *data, size_t n);

/* ---- Raw CAN frames ---------------------------------------------------------------------------------------------- */

struct evstim_can_ids {
    uint16_t events, epoch, clock, edges, marks; /* 11-bit: 0x1A2, 0x2A2, 0x322, 0x422, 0x3A2 for node 0x22 */
};

struct evstim_can {
    const struct evstim_sink *sink;
    struct evstim_can_ids ids;
    uint16_t width, height; /* at most 512 each */
    uint64_t near_tick;     /* time of the last frame that had one */
    uint16_t tick_us;
    uint16_t epoch_sent, epoch_dropped;
    uint32_t since_epoch; /* events received since the last epoch frame */
    uint8_t last[64], last_length, last_seq;
    bool timed;   /* an epoch frame has arrived */
    bool clocked; /* a clock frame has arrived */
    uint32_t events;
    uint32_t edges;
    uint32_t marks;
    int32_t lost;     /* sent and not received; below 0 while frames come out of order; stays at its bounds */
    uint32_t dropped; /* dropped by the camera */
    uint32_t gaps;    /* frames whose sequence count was not the next */
    uint32_t repeated;     /* frames that came twice in a row, used once */
    uint32_t before_epoch; /* events frames before any epoch frame: they have no time */
    uint32_t before_clock; /* events frames before any clock frame: their times are known modulo 2^30 ticks */
    uint32_t malformed;    /* frames that no camera of this size sends */
};

void evstim_can_init(struct evstim_can *can, const struct evstim_can_ids *ids, uint16_t width, uint16_t height,
                     const struct evstim_sink *sink);

/* Process one data frame of a standard (11-bit) identifier; `fd` is true for CAN FD. Other identifiers are ignored. */
void evstim_can_frame(struct evstim_can *can, uint32_t identifier, bool fd, const uint8_t *data, size_t n);

/* ---- DAVIS346 USB words ------------------------------------------------------------------------------------------ */

/* Reads bulk IN endpoint 0x82. Words of APS frames and of the IMU are skipped and counted. */
struct evstim_davis {
    const struct evstim_sink *sink;
    uint64_t wrap_us; /* device time of the last wrap */
    uint64_t time_us; /* device time of the last timestamp or wrap */
    uint16_t columns, rows;
    uint16_t row;
    uint8_t low_byte; /* first half of a word that was split */
    bool half;
    bool turned;
    uint32_t events;
    uint32_t edges;
    uint32_t resets; /* restarts of device time at zero */
    uint32_t row_outside, column_outside, time_not_increasing, unknown_special, unknown_misc; /* faults */
    uint32_t not_interpreted; /* valid words of APS frames and of the IMU */
};

/* Prepare for a camera of `width` x `height` pixels (346 x 260). `turned`: the invert bit of the orientation
 * register is set, so row words carry x and column words y. */
void evstim_davis_init(struct evstim_davis *davis, uint16_t width, uint16_t height, bool turned,
                       const struct evstim_sink *sink);
void evstim_davis_word(struct evstim_davis *davis, uint16_t word);
void evstim_davis_push(struct evstim_davis *davis, const uint8_t *bytes, size_t n);

#ifdef __cplusplus
}
#endif

#endif
