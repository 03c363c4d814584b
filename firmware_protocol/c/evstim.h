/* evstim: events from a serial line, a CAN bus or a DAVIS346, for software that has no operating system.
 *
 * C99, freestanding: needs <stdint.h>, <stddef.h> and <stdbool.h>, and no library at all. No heap, no floating point,
 * no division, no recursion, no global state. The caller owns every struct and every buffer; a struct is made ready by
 * its `_init` function and then fed bytes, words or frames as they come, in pieces of any size. What they hold is
 * handed to the callbacks of a sink. No input whatever makes the library read or write outside what it was given, and
 * whatever it refuses it counts.
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

/* ---- What comes out ---------------------------------------------------------------------------------------------- */

/* A pixel saw its light change. x counts columns from the left, y rows from the top. */
struct evstim_event {
    uint64_t t_us; /* device time, microseconds */
    uint16_t x;
    uint16_t y;
    bool on; /* true: brighter, false: darker */
};

enum evstim_edge_kind { EVSTIM_RISING = 2, EVSTIM_FALLING = 3, EVSTIM_PULSE = 4 };

/* Something happened on the camera's external input. */
struct evstim_edge {
    uint64_t t_us;
    uint8_t kind;    /* enum evstim_edge_kind */
    uint8_t channel; /* which input */
    uint16_t seq;    /* number of the edge at its source, 0 where the source counts none */
};

/* A packet of another service than events and edges: housekeeping (3, 25), verification (1, x), ... */
struct evstim_report {
    uint64_t t_us;
    uint8_t service, subtype;
    const uint8_t *data;
    size_t length;
};

/* Where decoded things go. The pointers are good during the call only; any of the functions may be NULL. */
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

/* The length of the data before a CRC-32C, big-endian, of all before it; 0 where that does not fit. */
size_t evstim_sealed_length(const uint8_t *bytes, size_t n);

/* ---- Frames out of bytes: COBS, SLIP, KISS ----------------------------------------------------------------------- */

struct evstim_deframer {
    uint8_t *buffer;
    size_t capacity;
    size_t length; /* bytes of the frame so far */
    uint8_t left;  /* COBS: bytes until the next code byte. SLIP: 1 after an escape byte */
    uint8_t code;  /* COBS: the last code byte, 0 before the first. KISS: 1 after the command byte */
    bool broken;   /* this frame cannot become whole any more */
    uint32_t frames;    /* whole frames */
    uint32_t malformed; /* frames that broke the rules of their framing */
    uint32_t too_long;  /* frames that did not fit the buffer */
    uint32_t wrong_crc; /* KISS frames with a wrong CRC-32C */
};

/* Make ready. A frame may be as long as the buffer, after the framing is taken off but for KISS's CRC-32C. */
void evstim_deframer_init(struct evstim_deframer *deframer, uint8_t *buffer, size_t capacity);

/* Take one byte. Returns the length of the frame that this byte completed, which lies at deframer->buffer until the
 * next call, or 0. Empty frames (runs of delimiters) are passed over. */
size_t evstim_cobs_byte(struct evstim_deframer *deframer, uint8_t byte);
size_t evstim_slip_byte(struct evstim_deframer *deframer, uint8_t byte);
size_t evstim_kiss_byte(struct evstim_deframer *deframer, uint8_t byte);

/* ---- Event blocks ------------------------------------------------------------------------------------------------ */

/* Reads the blocks of docs/telemetry.md, of one camera. */
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
    uint32_t dropped; /* events that the camera says it dropped; at least, since a block can tell of 65535 */
};

/* Make ready for a camera of `width` x `height` pixels, each 1 to 4096. */
void evstim_blocks_init(struct evstim_blocks *blocks, uint16_t width, uint16_t height, const struct evstim_sink *sink);

/* Take one whole block, checked by the CRC of the packet that brought it. Blocks tell 32 bits of the time, and mean the
 * time nearest to `near_us`: that of the packet, or blocks->last_us. Returns whether it was good; if not, nothing of it
 * has been delivered. */
bool evstim_block(struct evstim_blocks *blocks, const uint8_t *bytes, size_t n, uint64_t near_us);

/* ---- Telemetry: packets on a serial line, or in the messages of ISO-TP and CFP ----------------------------------- */

/* Profiles ccsds-cobs, ccsds-slip, ccsds-kiss, csp-kiss. */
enum evstim_framing { EVSTIM_COBS, EVSTIM_SLIP, EVSTIM_KISS, EVSTIM_CSP_KISS };
enum { EVSTIM_APID = 0x2A0, EVSTIM_SCIENCE_APID = 0x2A1, EVSTIM_CSP_NODE = 10, EVSTIM_CSP_PEER = 1 };

/* The count that the next packet with a block should have. */
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
    uint32_t missing;    /* packets with a block that never came */
    uint32_t disordered; /* packets with a block whose count was behind: repeated, late, or the camera began anew */
};

/* Make ready. The buffer holds one packet: the longest block and 22 bytes, 26 with KISS; with the camera's default of
 * 1024 bytes for a block, 1046 or 1050. */
void evstim_telemetry_init(struct evstim_telemetry *telemetry, enum evstim_framing framing, uint8_t *buffer,
                           size_t capacity, uint16_t width, uint16_t height, const struct evstim_sink *sink);
void evstim_telemetry_push(struct evstim_telemetry *telemetry, const uint8_t *bytes, size_t n);

/* Take one whole packet, from a carrier that keeps packets apart: profile ccsds (a space packet, as ISO-TP brings it),
 * profile csp (a CSP packet with its CRC-32C behind it, as CFP brings it). The telemetry's buffer is not used.
 * Returns whether it was good. */
bool evstim_telemetry_packet(struct evstim_telemetry *telemetry, const uint8_t *packet, size_t n);
bool evstim_telemetry_csp_packet(struct evstim_telemetry *telemetry, const uint8_t *packet, size_t n);

/* ---- Messages in CAN frames: carriages isotp and cfp ------------------------------------------------------------- */

/* Puts the messages of one ISO-TP sender together (ISO 15765-2, normal addressing, classic CAN and CAN FD). */
struct evstim_isotp {
    uint8_t *buffer;
    size_t capacity;
    size_t length, at;  /* of the message under way, 0 for none; bytes that have come */
    uint8_t serial;     /* of the last frame */
    uint8_t in_block;   /* consecutive frames since the last flow control */
    uint8_t block_size; /* frames between flow controls that we ask for, 0 for all; may be set after init */
    uint8_t separation; /* STmin that we ask for: 0 to 127 ms; likewise */
    uint8_t reply[8];   /* flow control to send at once, where has_reply is true; with flow control off leave it */
    bool has_reply;     /* set anew by each frame */
    uint32_t messages;  /* whole ones */
    uint32_t malformed; /* frames that ISO-TP does not have */
    uint32_t too_long;  /* messages that the buffer cannot hold */
    uint32_t disordered;        /* messages given up: a frame was missing or repeated */
    uint32_t cut_short;         /* messages given up: another began */
    uint32_t without_beginning; /* frames of no message under way */
};

/* Make ready. The buffer holds one message: as evstim_telemetry_init says. */
void evstim_isotp_init(struct evstim_isotp *isotp, uint8_t *buffer, size_t capacity);

/* Take the data of one frame of the camera's identifier `telemetry`. Returns the length of the message that it
 * completed, which lies in the buffer until the next call, or 0. There is no clock: a message whose end never comes
 * stays under way until the next one begins. */
size_t evstim_isotp_frame(struct evstim_isotp *isotp, const uint8_t *data, size_t n);

/* Puts the CSP packets of one node together (CFP 2, CSP version 2, classic CAN). */
struct evstim_cfp {
    uint8_t *buffer;
    size_t capacity;
    uint16_t node, peer; /* CSP addresses of the camera, of which six bits count, and of this computer */
    size_t length;       /* of the packet under way, 0 for none */
    uint32_t connection; /* priority and packet count of it */
    uint8_t next;        /* frame count that should come */
    uint32_t packets;    /* whole ones; their CRC-32C is yet to be checked */
    uint32_t malformed;  /* frames that CFP does not have */
    uint32_t too_long;   /* packets that the buffer cannot hold */
    uint32_t disordered;        /* packets given up: a frame was missing or repeated */
    uint32_t cut_short;         /* packets given up: another began */
    uint32_t without_beginning; /* frames of no packet under way */
};

/* Make ready. The buffer holds one packet: the longest block and 19 bytes. */
void evstim_cfp_init(struct evstim_cfp *cfp, uint16_t node, uint16_t peer, uint8_t *buffer, size_t capacity);

/* Take one classic frame of an extended (29-bit) identifier; those of others are passed over. Returns the length of the
 * packet that it completed, which lies in the buffer until the next call, or 0. */
size_t evstim_cfp_frame(struct evstim_cfp *cfp, uint32_t identifier, const uint8_t *data, size_t n);

/* ---- Raw CAN frames ---------------------------------------------------------------------------------------------- */

struct evstim_can_ids {
    uint16_t events, epoch, clock, edges, marks; /* 11-bit: 0x1A2, 0x2A2, 0x322, 0x422, 0x3A2 for node 0x22 */
};

struct evstim_can {
    const struct evstim_sink *sink;
    struct evstim_can_ids ids;
    uint16_t width, height; /* at most 512 each */
    uint64_t near_tick;     /* time last told */
    uint16_t tick_us;
    uint16_t epoch_sent, epoch_dropped;
    uint32_t since_epoch; /* events received since the last epoch frame */
    uint8_t last[64], last_length, last_seq;
    bool timed;   /* an epoch frame has come */
    bool clocked; /* a clock frame has come */
    uint32_t events;
    uint32_t edges;
    uint32_t marks;
    int32_t lost;     /* sent and not received; below 0 while frames come out of order; stays at its bounds */
    uint32_t dropped; /* dropped by the camera */
    uint32_t gaps;    /* times that the sequence count was not the next */
    uint32_t repeated;     /* frames that came twice in a row, used once */
    uint32_t before_epoch; /* events frames before any epoch frame: they have no time */
    uint32_t before_clock; /* events frames before any clock frame: their times are known modulo 2^30 ticks */
    uint32_t malformed;    /* frames that no camera of this size sends */
};

void evstim_can_init(struct evstim_can *can, const struct evstim_can_ids *ids, uint16_t width, uint16_t height,
                     const struct evstim_sink *sink);

/* Take one data frame of a standard (11-bit) identifier; `fd` tells CAN FD from classic. Others are passed over. */
void evstim_can_frame(struct evstim_can *can, uint32_t identifier, bool fd, const uint8_t *data, size_t n);

/* ---- DAVIS346 USB words ------------------------------------------------------------------------------------------ */

/* Reads bulk IN endpoint 0x82. Words of APS frames and of the IMU are passed over and counted. */
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
    uint32_t resets; /* device time began at zero again */
    uint32_t row_outside, column_outside, time_not_increasing, unknown_special, unknown_misc; /* faults */
    uint32_t not_interpreted; /* sound words of APS frames and of the IMU */
};

/* Make ready for a camera of `width` x `height` pixels (346 x 260). `turned`: the invert bit of the orientation
 * register is set, so row words carry x and column words y. */
void evstim_davis_init(struct evstim_davis *davis, uint16_t width, uint16_t height, bool turned,
                       const struct evstim_sink *sink);
void evstim_davis_word(struct evstim_davis *davis, uint16_t word);
void evstim_davis_push(struct evstim_davis *davis, const uint8_t *bytes, size_t n);

#ifdef __cplusplus
}
#endif

#endif
