/* Event blocks, in the layout of docs/packets.md.
 *
 * A block is read twice, straight from the receive buffer: first only to check, then to deliver. The first pass refuses
 * every malformed block, so the second needs no checks. */
#include "evstim.h"
#include "evstim_time.h"

enum { HEADER_BYTES = 14, VERSION = 1, MOST_RICE_BITS = 27, ESCAPE = 16, EDGE_BYTES = 8 };
enum mode { FLAT, ROWS, BITMAP, EDGE };

static const struct {
    uint32_t us, last; /* length of a tick; the highest number of ticks that a block spans */
} ticks[4] = {{1, 2147483647}, {10, 214748364}, {100, 21474836}, {1000, 2147483}};

struct header {
    uint8_t mode, tick_code, polarity;
    uint16_t n, dropped, width, height;
    uint32_t base;
};

/* ---- Arithmetic without division --------------------------------------------------------------------------------- */

/* 2^32 / divisor, rounded down (2^32 - 1 for 1), bit by bit. */
static uint32_t reciprocal(uint32_t divisor)
{
    uint32_t quotient = 0;
    uint64_t rest = 0;
    for (int bit = 31; bit >= 0; bit--) {
        rest = rest << 1 | 1;
        quotient <<= 1;
        if (rest >= divisor) {
            rest -= divisor;
            quotient |= 1;
        }
    }
    return quotient;
}

/* value / divisor. The reciprocal falls short by less than 1 / 2^32, so the product by less than 1. */
static inline uint32_t divide(uint32_t value, uint32_t divisor, uint32_t reciprocal_of_it)
{
    uint32_t quotient = (uint32_t)((uint64_t)value * reciprocal_of_it >> 32);
    return quotient + (value - quotient * divisor >= divisor);
}

/* ---- Bits, most significant first -------------------------------------------------------------------------------- */

struct bits {
    const uint8_t *bytes;
    uint32_t at, end; /* in bits; `at` may pass `end` by one number, which is then detected */
};

/* The next 32 bits; beyond the end they are zeros. */
static inline uint32_t peek(const struct bits *b)
{
    uint32_t first = b->at >> 3, shift = b->at & 7u, last = b->end >> 3;
    const uint8_t *p = b->bytes + first;
    if (first + 5 <= last) {
        uint32_t word = (uint32_t)p[0] << 24 | (uint32_t)p[1] << 16 | (uint32_t)p[2] << 8 | p[3];
        return word << shift | (uint32_t)p[4] >> (8 - shift);
    }
    uint64_t word = 0;
    for (uint32_t i = 0; i < 5; i++)
        word = word << 8 | (first + i < last ? b->bytes[first + i] : 0);
    return (uint32_t)(word << shift >> 8);
}

/* The first `width` (0 to 31) of 32 bits. */
static inline uint32_t head(uint32_t bits, uint32_t width)
{
    return bits >> 1 >> (31 - width);
}

static inline uint32_t take(struct bits *b, uint32_t width)
{
    uint32_t value = head(peek(b), width);
    b->at += width;
    return value;
}

/* The number of ones among 32 bits before the first zero, at most 16. */
static inline uint32_t ones_in_front(uint32_t bits)
{
#if defined(__GNUC__) && !defined(EVSTIM_NO_CLZ)
    return (uint32_t)__builtin_clz(~bits | 1u << (31 - ESCAPE));
#else
    uint32_t ones = 0;
    while (ones < ESCAPE && bits >> (31 - ones) & 1u)
        ones++;
    return ones;
#endif
}

/* A Rice-coded number with `k` bits of rest; false if it is an escape, which is skipped. */
static inline bool rice(struct bits *b, uint32_t k, uint32_t *value, uint32_t more, uint32_t *tail)
{
    uint32_t window = peek(b), ones = ones_in_front(window), rest;
    if (ones == ESCAPE) {
        b->at += ESCAPE;
        return false;
    }
    b->at += ones + 1;
    if (ones + 1 + k + more <= 32) {
        rest = head(window << (ones + 1), k + more);
        b->at += k + more;
    } else {
        rest = take(b, k + more);
    }
    *tail = rest & more;
    *value = ones << k | rest >> more;
    return true;
}

/* True if only fewer than eight zero bits are left. */
static bool ended(const struct bits *b)
{
    return b->at <= b->end && b->end - b->at < 8 && head(peek(b), b->end - b->at) == 0;
}

/* ---- Reading of the payload -------------------------------------------------------------------------------------- */

struct walk {
    struct bits bits;
    const struct evstim_blocks *camera;
    const struct evstim_sink *sink; /* NULL while checking */
    uint64_t base_us;
    uint32_t tick_us, last_tick;
    uint32_t tick, address; /* of the last event */
    uint32_t left;          /* events still to come */
    uint8_t polarity;
};

static inline void deliver(struct walk *w, bool on)
{
    const struct evstim_blocks *c = w->camera;
    uint32_t y = divide(w->address, c->width, c->per_width);
    struct evstim_event event = {
        .t_us = w->base_us + w->tick * w->tick_us,
        .x = (uint16_t)(w->address - y * c->width),
        .y = (uint16_t)y,
        .on = on,
    };
    w->sink->event(w->sink->context, &event);
}

/* Return true if an event is valid here; deliver it in the second pass. */
static inline bool event(struct walk *w, bool on)
{
    if (w->left == 0 || w->bits.at > w->bits.end)
        return false;
    w->left--;
    if (w->sink != NULL)
        deliver(w, on);
    return true;
}

/* Go to an explicit address, `later` ticks on; false if it is outside the array or goes back. */
static bool go_to_place(struct walk *w, uint32_t later)
{
    const struct evstim_blocks *c = w->camera;
    uint32_t y = take(&w->bits, c->y_bits), x = take(&w->bits, c->x_bits), address = y * c->width + x;
    if (y >= c->height || x >= c->width || (later == 0 && address < w->address) || later > w->last_tick - w->tick)
        return false;
    w->tick += later;
    w->address = address;
    return true;
}

/* Go `step` pixels on along the raster, from the end of a tick to the start of the next. */
static inline bool go_on(struct walk *w, uint32_t step)
{
    const struct evstim_blocks *c = w->camera;
    uint32_t sum = w->address + step, later = divide(sum, c->pixels, c->per_pixels);
    if (later > w->last_tick - w->tick)
        return false;
    w->tick += later;
    w->address = sum - later * c->pixels;
    return true;
}

static bool walk_flat(struct walk *w)
{
    const struct evstim_blocks *c = w->camera;
    uint32_t tick_bits = 31u - c->y_bits - c->x_bits;
    for (bool first = true; w->left != 0; first = false) {
        uint32_t word = peek(&w->bits), tick = head(word, tick_bits);
        uint32_t y = head(word << tick_bits, c->y_bits), x = head(word << tick_bits << c->y_bits, c->x_bits);
        uint32_t address = y * c->width + x;
        if (y >= c->height || x >= c->width || tick > w->last_tick || (first && tick != 0))
            return false;
        if (tick < w->tick || (tick == w->tick && address < w->address))
            return false;
        w->bits.at += 32;
        w->tick = tick;
        w->address = address;
        if (!event(w, word & 1u))
            return false;
    }
    return true;
}

static bool walk_rows(struct walk *w)
{
    uint32_t k = take(&w->bits, 8), own = w->polarity == 0;
    if (k > MOST_RICE_BITS || !go_to_place(w, 0))
        return false;
    uint32_t on = own ? take(&w->bits, 1) : w->polarity & 1u;
    while (event(w, on)) {
        if (w->left == 0)
            return true;
        uint32_t step, tail;
        if (rice(&w->bits, k, &step, own, &tail)) {
            if (!go_on(w, step))
                return false;
            on = own ? tail : on;
        } else {
            if (!go_to_place(w, take(&w->bits, 31)))
                return false;
            on = own ? take(&w->bits, 1) : on;
        }
    }
    return false;
}

/* The pixels of a span after its length. */
static bool walk_span(struct walk *w, uint32_t length)
{
    uint32_t last = w->address + length - 1;
    bool solid = length >= 3 ? take(&w->bits, 1) : length == 2;
    bool alike = w->polarity != 0 || (length >= 2 && take(&w->bits, 1));
    bool on = w->polarity != 0 ? w->polarity & 1u : alike && take(&w->bits, 1);
    for (uint32_t first = w->address; w->address <= last; w->address++) {
        if (w->bits.at > w->bits.end)
            return false;
        if (w->address != first && w->address != last && !solid && !take(&w->bits, 1))
            continue;
        if (!event(w, alike ? on : take(&w->bits, 1)))
            return false;
    }
    w->address = last;
    return true;
}

static bool walk_bitmap(struct walk *w)
{
    uint32_t k_step = take(&w->bits, 8), k_length = take(&w->bits, 8), less_one, step, none;
    if (k_step > MOST_RICE_BITS || k_length > MOST_RICE_BITS || !go_to_place(w, 0))
        return false;
    for (;;) {
        if (!rice(&w->bits, k_length, &less_one, 0, &none) || less_one >= w->camera->pixels - w->address)
            return false;
        if (!walk_span(w, less_one + 1))
            return false;
        if (w->left == 0)
            return true;
        bool gone = rice(&w->bits, k_step, &step, 0, &none) ? go_on(w, step) : go_to_place(w, take(&w->bits, 31));
        if (!gone)
            return false;
    }
}

static bool walk_edges(struct walk *w)
{
    for (uint32_t before = 0, first = 1; w->left != 0; w->left--, first = 0) {
        uint32_t since = take(&w->bits, 16) << 16;
        since |= take(&w->bits, 16);
        uint32_t kind = take(&w->bits, 8);
        struct evstim_edge edge = {
            .t_us = w->base_us + since,
            .kind = (uint8_t)kind,
            .channel = (uint8_t)take(&w->bits, 8),
            .seq = (uint16_t)take(&w->bits, 16),
        };
        if (w->bits.at > w->bits.end || since < before || since > w->last_tick || (first && since != 0))
            return false;
        if (kind < EVSTIM_RISING || kind > EVSTIM_PULSE)
            return false;
        before = since;
        if (w->sink != NULL)
            w->sink->edge(w->sink->context, &edge);
    }
    return true;
}

/* Read a block whose header is good: without a sink to check it, with one to deliver it. */
static bool walk(const struct evstim_blocks *camera, const struct header *h, const uint8_t *bytes, size_t n,
                 const struct evstim_sink *sink, uint64_t base_us)
{
    static bool (*const walks[])(struct walk *) = {walk_flat, walk_rows, walk_bitmap, walk_edges};
    struct walk w = {
        .bits = {.bytes = bytes, .at = 8 * HEADER_BYTES, .end = (uint32_t)n * 8},
        .camera = camera,
        .sink = sink,
        .base_us = base_us,
        .tick_us = ticks[h->tick_code].us,
        .last_tick = ticks[h->tick_code].last,
        .left = h->n,
        .polarity = h->polarity,
    };
    return walks[h->mode](&w) && ended(&w.bits);
}

/* ---- The header -------------------------------------------------------------------------------------------------- */

static uint8_t crc8(const uint8_t *bytes, size_t n)
{
    uint32_t crc = 0xFF;
    for (size_t i = 0; i < n; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 0x80u ? crc << 1 ^ 0x12Fu : crc << 1;
    }
    return (uint8_t)(crc ^ 0xFFu);
}

static bool read_header(struct header *h, const uint8_t *b, size_t n)
{
    if (n < HEADER_BYTES || n > UINT16_MAX || b[0] >> 4 != VERSION || crc8(b, HEADER_BYTES - 1) != b[HEADER_BYTES - 1])
        return false;
    *h = (struct header){
        .mode = b[0] & 15u,
        .tick_code = b[1] >> 6,
        .polarity = b[1] >> 4 & 3u,
        .n = (uint16_t)(b[2] << 8 | b[3]),
        .base = (uint32_t)b[4] << 24 | (uint32_t)b[5] << 16 | (uint32_t)b[6] << 8 | b[7],
        .dropped = (uint16_t)(b[8] << 8 | b[9]),
        .width = (uint16_t)((b[10] << 4 | b[11] >> 4) + 1),
        .height = (uint16_t)(((b[11] & 15) << 8 | b[12]) + 1),
    };
    bool coded = h->mode == ROWS || h->mode == BITMAP;
    return h->mode <= EDGE && (b[1] & 15u) == 0 && h->polarity != 1 && (coded || h->polarity == 0)
           && (h->mode != EDGE || h->tick_code == 0) && (h->mode == FLAT || h->n != 0);
}

/* ---- Functions of the header file -------------------------------------------------------------------------------- */

static uint8_t bits_of(uint32_t value)
{
    uint8_t bits = 0;
    for (; value != 0; value >>= 1)
        bits++;
    return bits;
}

void evstim_blocks_init(struct evstim_blocks *blocks, uint16_t width, uint16_t height, const struct evstim_sink *sink)
{
    *blocks = (struct evstim_blocks){
        .sink = sink,
        .width = width,
        .height = height,
        .pixels = (uint32_t)width * height,
        .per_pixels = reciprocal((uint32_t)width * height),
        .per_width = reciprocal(width),
        .x_bits = bits_of(width - 1u),
        .y_bits = bits_of(height - 1u),
    };
}

bool evstim_block(struct evstim_blocks *blocks, const uint8_t *bytes, size_t n, uint64_t near_us)
{
    struct header h;
    if (!read_header(&h, bytes, n)) {
        blocks->refused++;
        return false;
    }
    if (h.width != blocks->width || h.height != blocks->height) {
        blocks->other_size++;
        return false;
    }
    uint64_t base_us = evstim_unwrapped(h.base, 32, near_us);
    if (!walk(blocks, &h, bytes, n, NULL, base_us)) {
        blocks->refused++;
        return false;
    }
    bool edges = h.mode == EDGE;
    if (edges ? blocks->sink->edge != NULL : blocks->sink->event != NULL)
        walk(blocks, &h, bytes, n, blocks->sink, base_us);
    blocks->blocks++;
    blocks->last_us = base_us;
    blocks->dropped += h.dropped;
    if (edges)
        blocks->edges += h.n;
    else
        blocks->events += h.n;
    return true;
}
