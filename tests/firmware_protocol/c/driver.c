/* Answers requests on stdin with what the library makes of their bytes, for tests in another language.
 *
 * Request:  u8 mode, u8 flags, u16 width, u16 height, u32 piece, u32 n, n bytes. All integers little-endian.
 *           piece: the bytes are pushed in pieces of this many.
 * Reply:    u32 sizes of four sections, then they: frames (u32 length and bytes each), events (13 bytes each: u64 t,
 *           u16 x, u16 y, u8 on), edges (12 bytes each: u64 t, u8 kind, u8 channel, u16 seq), counters (u32 each).
 *           Reports stand among the frames: u8 service, u8 subtype, u64 t, data.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "evstim.h"

enum { FRAMES, EVENTS, EDGES, COUNTERS, SECTIONS };

struct section {
    uint8_t *bytes;
    size_t length, capacity;
};

static struct section sections[SECTIONS];

static void put(int which, const void *bytes, size_t n)
{
    struct section *s = &sections[which];
    if (s->length + n > s->capacity) {
        s->capacity = 2 * (s->length + n);
        s->bytes = realloc(s->bytes, s->capacity);
        if (s->bytes == NULL)
            abort();
    }
    memcpy(s->bytes + s->length, bytes, n);
    s->length += n;
}

static void put_u32(int which, uint32_t value)
{
    put(which, &value, sizeof value);
}

static void on_event(void *context, const struct evstim_event *event)
{
    uint8_t on = event->on;
    (void)context;
    put(EVENTS, &event->t_us, 8);
    put(EVENTS, &event->x, 2);
    put(EVENTS, &event->y, 2);
    put(EVENTS, &on, 1);
}

static void on_edge(void *context, const struct evstim_edge *edge)
{
    (void)context;
    put(EDGES, &edge->t_us, 8);
    put(EDGES, &edge->kind, 1);
    put(EDGES, &edge->channel, 1);
    put(EDGES, &edge->seq, 2);
}

/* Marks stand among the frames, as edges do. */
static void on_mark(void *context, const struct evstim_edge *mark)
{
    (void)context;
    put_u32(FRAMES, 12);
    put(FRAMES, &mark->t_us, 8);
    put(FRAMES, &mark->kind, 1);
    put(FRAMES, &mark->channel, 1);
    put(FRAMES, &mark->seq, 2);
}

static void on_report(void *context, const struct evstim_report *report)
{
    (void)context;
    put_u32(FRAMES, (uint32_t)(10 + report->length));
    put(FRAMES, &report->service, 1);
    put(FRAMES, &report->subtype, 1);
    put(FRAMES, &report->t_us, 8);
    put(FRAMES, report->data, report->length);
}

static const struct evstim_sink sink = {on_event, on_edge, on_mark, on_report, NULL};

struct request {
    uint8_t mode, flags;
    uint16_t width, height;
    uint32_t piece, n;
};

/* The buffer is of the size asked for and no larger, so that a sanitizer sees a step beyond it. */
static void deframe(const struct request *r, const uint8_t *bytes)
{
    uint8_t *buffer = malloc(r->width);
    struct evstim_deframer d;
    if (buffer == NULL)
        abort();
    evstim_deframer_init(&d, buffer, r->width);
    for (uint32_t i = 0; i < r->n; i++) {
        size_t length = r->mode == 'c'   ? evstim_cobs_byte(&d, bytes[i])
                        : r->mode == 's' ? evstim_slip_byte(&d, bytes[i])
                                         : evstim_kiss_byte(&d, bytes[i]);
        if (length != 0) {
            put_u32(FRAMES, (uint32_t)length);
            put(FRAMES, d.buffer, length);
        }
    }
    put_u32(COUNTERS, d.frames);
    put_u32(COUNTERS, d.malformed);
    put_u32(COUNTERS, d.too_long);
    put_u32(COUNTERS, d.wrong_crc);
    free(buffer);
}

static void davis(const struct request *r, const uint8_t *bytes)
{
    struct evstim_davis d;
    evstim_davis_init(&d, r->width, r->height, r->flags & 1, &sink);
    for (uint32_t i = 0; i < r->n; i += r->piece)
        evstim_davis_push(&d, bytes + i, r->n - i < r->piece ? r->n - i : r->piece);
    const uint32_t counters[] = {d.events,         d.edges,           d.resets,       d.row_outside,
                                 d.column_outside, d.time_not_increasing, d.unknown_special, d.unknown_misc,
                                 d.not_interpreted};
    put(COUNTERS, counters, sizeof counters);
    put(COUNTERS, &d.time_us, 8);
}

/* The bytes are records of u64 near_us, u32 length, block. A copy is as long as its block, for the sanitizer. */
static void blocks(const struct request *r, const uint8_t *bytes)
{
    struct evstim_blocks b;
    evstim_blocks_init(&b, r->width, r->height, &sink);
    for (uint32_t at = 0; at < r->n;) {
        uint64_t near_us;
        uint32_t n;
        memcpy(&near_us, bytes + at, 8);
        memcpy(&n, bytes + at + 8, 4);
        uint8_t *copy = malloc(n);
        if (copy == NULL && n != 0)
            abort();
        memcpy(copy, bytes + at + 12, n);
        size_t before = sections[EVENTS].length + sections[EDGES].length;
        if (!evstim_block(&b, copy, n, near_us) && sections[EVENTS].length + sections[EDGES].length != before)
            abort(); /* something of a bad block was delivered */
        free(copy);
        at += 12 + n;
    }
    const uint32_t counters[] = {b.blocks, b.refused, b.other_size, b.events, b.edges, b.dropped};
    put(COUNTERS, counters, sizeof counters);
}

static void put_telemetry(const struct evstim_telemetry *t)
{
    const uint32_t counters[] = {t->packets,          t->others,            t->refused,        t->missing,
                                 t->disordered,       t->blocks.blocks,     t->blocks.refused, t->blocks.other_size,
                                 t->blocks.events,    t->blocks.edges,      t->blocks.dropped, t->frames.frames,
                                 t->frames.malformed, t->frames.too_long,   t->frames.wrong_crc};
    put(COUNTERS, counters, sizeof counters);
}

enum { CAPACITY = 8192 + 26 };

static void telemetry(const struct request *r, const uint8_t *bytes)
{
    const enum evstim_framing framing = r->mode == 'S'   ? EVSTIM_SLIP
                                        : r->mode == 'K' ? EVSTIM_KISS
                                        : r->mode == 'X' ? EVSTIM_CSP_KISS
                                                         : EVSTIM_COBS;
    uint8_t *buffer = malloc(CAPACITY);
    struct evstim_telemetry t;
    if (buffer == NULL)
        abort();
    evstim_telemetry_init(&t, framing, buffer, CAPACITY, r->width, r->height, &sink);
    if (r->mode == 'P')
        evstim_telemetry_packet(&t, bytes, r->n);
    else if (r->mode == 'Y')
        evstim_telemetry_csp_packet(&t, bytes, r->n);
    else
        for (uint32_t i = 0; i < r->n; i += r->piece)
            evstim_telemetry_push(&t, bytes + i, r->n - i < r->piece ? r->n - i : r->piece);
    put_telemetry(&t);
    free(buffer);
}

/* The bytes are records of u32 identifier, u8 length, data; `piece` is the length of the buffer, flags the block size.
 * Flow control stands among the frames. */
static void isotp(const struct request *r, const uint8_t *bytes)
{
    uint8_t *buffer = malloc(r->piece);
    struct evstim_telemetry t;
    struct evstim_isotp s;
    evstim_telemetry_init(&t, EVSTIM_COBS, NULL, 0, r->width, r->height, &sink);
    evstim_isotp_init(&s, buffer, r->piece);
    s.block_size = r->flags;
    for (uint32_t at = 0; at < r->n; at += 5u + bytes[at + 4]) {
        uint8_t *copy = malloc(bytes[at + 4]);
        memcpy(copy, bytes + at + 5, bytes[at + 4]);
        size_t length = evstim_isotp_frame(&s, copy, bytes[at + 4]);
        free(copy);
        if (s.has_reply) {
            put_u32(FRAMES, sizeof s.reply);
            put(FRAMES, s.reply, sizeof s.reply);
        }
        if (length != 0)
            evstim_telemetry_packet(&t, s.buffer, length);
    }
    put_telemetry(&t);
    const uint32_t counters[] = {s.messages,  s.malformed, s.too_long, s.disordered,
                                 s.cut_short, s.without_beginning};
    put(COUNTERS, counters, sizeof counters);
    free(buffer);
}

static void cfp(const struct request *r, const uint8_t *bytes)
{
    uint8_t *buffer = malloc(r->piece);
    struct evstim_telemetry t;
    struct evstim_cfp c;
    evstim_telemetry_init(&t, EVSTIM_COBS, NULL, 0, r->width, r->height, &sink);
    evstim_cfp_init(&c, t.csp_node, t.csp_peer, buffer, r->piece);
    for (uint32_t at = 0; at < r->n; at += 5u + bytes[at + 4]) {
        uint8_t *copy = malloc(bytes[at + 4]);
        uint32_t identifier;
        memcpy(&identifier, bytes + at, 4);
        memcpy(copy, bytes + at + 5, bytes[at + 4]);
        size_t length = evstim_cfp_frame(&c, identifier, copy, bytes[at + 4]);
        free(copy);
        if (length != 0)
            evstim_telemetry_csp_packet(&t, c.buffer, length);
    }
    put_telemetry(&t);
    const uint32_t counters[] = {c.packets,   c.malformed, c.too_long, c.disordered,
                                 c.cut_short, c.without_beginning};
    put(COUNTERS, counters, sizeof counters);
    free(buffer);
}

/* The bytes are records of u16 identifier, u8 fd, u8 length, data. */
static void can(const struct request *r, const uint8_t *bytes)
{
    const struct evstim_can_ids ids = {.events = 0x1A2, .epoch = 0x2A2, .clock = 0x322, .edges = 0x422, .marks = 0x3A2};
    struct evstim_can c;
    evstim_can_init(&c, &ids, r->width, r->height, &sink);
    for (uint32_t at = 0; at < r->n; at += 4u + bytes[at + 3]) {
        uint16_t identifier;
        uint8_t *copy = malloc(bytes[at + 3]);
        if (copy == NULL && bytes[at + 3] != 0)
            abort();
        memcpy(&identifier, bytes + at, 2);
        memcpy(copy, bytes + at + 4, bytes[at + 3]);
        evstim_can_frame(&c, identifier, bytes[at + 2], copy, bytes[at + 3]);
        free(copy);
    }
    const uint32_t counters[] = {c.events, c.edges,    c.marks,        (uint32_t)c.lost, c.dropped,
                                 c.gaps,   c.repeated, c.before_epoch, c.malformed};
    put(COUNTERS, counters, sizeof counters);
}

static void answer(const struct request *r, const uint8_t *bytes)
{
    switch (r->mode) {
    case 'r':
        put_u32(COUNTERS, evstim_crc16(EVSTIM_CRC16_START, bytes, r->n));
        break;
    case 'R':
        put_u32(COUNTERS, evstim_crc32c(0, bytes, r->n));
        break;
    case 'c':
    case 's':
    case 'k':
        deframe(r, bytes);
        break;
    case 'd':
        davis(r, bytes);
        break;
    case 'b':
        blocks(r, bytes);
        break;
    case 'C':
    case 'S':
    case 'K':
    case 'X':
    case 'P':
    case 'Y':
        telemetry(r, bytes);
        break;
    case 'I':
        isotp(r, bytes);
        break;
    case 'F':
        cfp(r, bytes);
        break;
    case 'n':
        can(r, bytes);
        break;
    default:
        abort();
    }
}

static void reply(void)
{
    for (int i = 0; i < SECTIONS; i++) {
        uint32_t length = (uint32_t)sections[i].length;
        fwrite(&length, sizeof length, 1, stdout);
    }
    for (int i = 0; i < SECTIONS; i++) {
        if (sections[i].length != 0)
            fwrite(sections[i].bytes, 1, sections[i].length, stdout);
        sections[i].length = 0;
    }
    fflush(stdout);
}

static int read_request(struct request *r)
{
    uint8_t head[14];
    if (fread(head, sizeof head, 1, stdin) != 1)
        return 0;
    r->mode = head[0];
    r->flags = head[1];
    memcpy(&r->width, head + 2, 2);
    memcpy(&r->height, head + 4, 2);
    memcpy(&r->piece, head + 6, 4);
    memcpy(&r->n, head + 10, 4);
    return 1;
}

int main(void)
{
    struct request request;
    while (read_request(&request)) {
        uint8_t *bytes = malloc(request.n); /* exactly as long as the input, for the sanitizer */
        if ((bytes == NULL && request.n != 0) || fread(bytes, 1, request.n, stdin) != request.n)
            return 1;
        answer(&request, bytes);
        reply();
        free(bytes);
    }
    for (int i = 0; i < SECTIONS; i++)
        free(sections[i].bytes);
    return 0;
}
