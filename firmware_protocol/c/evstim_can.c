/* Raw CAN frames, in the layout of docs/instrument.md: events that need no reassembly, little-endian.
 *
 * Events, classic, 64 bits:  t 16 | seq 3 | dt 7 | x0 9 | y0 9 | on0 1 | x1 9 | y1 9 | on1 1   (lowest bits first)
 * Events, FD:                u32 t | u8 seq | u8 n | u8 dropped | n x u24 (x 9 | y 9 | on 1 | dt 5) | zeros
 * Epoch:                     u32 (t in ticks 30 | tick code 2) | u16 events sent | u16 events dropped
 * Clock:                     u64 t_us
 * Mark:                      u32 t_us | u8 kind | u8 channel | u16 seq */
#include "evstim.h"
#include "evstim_time.h"

enum { CLASSIC_BYTES = 8, FD_HEAD_BYTES = 7, CELL_BYTES = 3, MOST_CELLS = 19, NO_SECOND = 127, SKIP = 31 };

static const uint16_t ticks_us[4] = {1, 10, 100, 1000};

struct frame {
    uint8_t seq, seq_bits; /* the bits that count */
    uint64_t tick;         /* of the first event */
};

static uint32_t u32(const uint8_t *p)
{
    return (uint32_t)p[3] << 24 | (uint32_t)p[2] << 16 | (uint32_t)p[1] << 8 | p[0];
}

static uint16_t u16(const uint8_t *p)
{
    return (uint16_t)(p[1] << 8 | p[0]);
}

static uint32_t u24(const uint8_t *p)
{
    return (uint32_t)p[2] << 16 | (uint32_t)p[1] << 8 | p[0];
}

/* value / divisor, bit by bit: once for a clock frame, and when the tick changes. */
static uint64_t divided(uint64_t value, uint32_t divisor)
{
    uint64_t quotient = 0, rest = 0;
    for (int bit = 63; bit >= 0; bit--) {
        rest = rest << 1 | (value >> bit & 1u);
        quotient <<= 1;
        if (rest >= divisor) {
            rest -= divisor;
            quotient |= 1;
        }
    }
    return quotient;
}

void evstim_can_init(struct evstim_can *can, const struct evstim_can_ids *ids, uint16_t width, uint16_t height,
                     const struct evstim_sink *sink)
{
    *can = (struct evstim_can){.ids = *ids, .width = width, .height = height, .sink = sink, .tick_us = 1};
}

static uint64_t near_us(const struct evstim_can *c)
{
    return c->near_tick * c->tick_us;
}

/* `pixel`: x 9 bits, y 9 bits, on 1 bit. */
static bool inside(const struct evstim_can *c, uint32_t pixel)
{
    return (pixel & 511u) < c->width && (pixel >> 9 & 511u) < c->height;
}

static void deliver(struct evstim_can *c, uint64_t tick, uint32_t pixel)
{
    struct evstim_event event = {
        .t_us = tick * c->tick_us,
        .x = pixel & 511u,
        .y = pixel >> 9 & 511u,
        .on = pixel >> 18 & 1u,
    };
    c->near_tick = tick;
    c->events++;
    c->since_epoch++;
    if (c->sink->event != NULL)
        c->sink->event(c->sink->context, &event);
}

/* Return true if a valid frame is new; update the sequence count. */
static bool is_new(struct evstim_can *c, const struct frame *f, const uint8_t *data, size_t n)
{
    bool same = c->last_length == n;
    for (size_t i = 0; same && i < n; i++)
        same = c->last[i] == data[i];
    if (same) {
        c->repeated++;
        return false;
    }
    if (c->last_length != 0 && ((c->last_seq + 1 - f->seq) & f->seq_bits) != 0)
        c->gaps++;
    c->before_clock += !c->clocked;
    c->last_seq = f->seq;
    c->last_length = (uint8_t)n;
    for (size_t i = 0; i < n; i++)
        c->last[i] = data[i];
    return true;
}

static bool classic_events(struct evstim_can *c, const uint8_t *data, size_t n)
{
    if (n != CLASSIC_BYTES)
        return false;
    uint32_t low = u32(data), high = u32(data + 4);
    uint32_t dt = low >> 19 & 127u, first = (low >> 26 | high << 6) & 0x7FFFFu, second = high >> 13;
    bool two = dt != NO_SECOND;
    if (!inside(c, first) || (two ? !inside(c, second) : second != 0))
        return false;
    struct frame f = {
        .seq = low >> 16 & 7u, .seq_bits = 7, .tick = evstim_unwrapped(low & 0xFFFFu, 16, c->near_tick)};
    if (is_new(c, &f, data, n)) {
        deliver(c, f.tick, first);
        if (two)
            deliver(c, f.tick + dt, second);
    }
    return true;
}

/* The shortest data length of CAN FD that holds `n` bytes, for n from 9 to 64. */
static size_t fd_length(size_t n)
{
    size_t step = n <= 24 ? 4 : n <= 32 ? 8 : 16;
    return (n + step - 1) & ~(step - 1);
}

static bool is_sound_fd(const struct evstim_can *c, const uint8_t *data, size_t n)
{
    size_t cells = n < FD_HEAD_BYTES ? 0 : data[5], end = FD_HEAD_BYTES + CELL_BYTES * cells;
    if (cells == 0 || cells > MOST_CELLS || n != fd_length(end))
        return false;
    for (size_t at = FD_HEAD_BYTES; at < end; at += CELL_BYTES)
        if (u24(data + at) >> 19 != SKIP && !inside(c, u24(data + at)))
            return false;
    for (size_t at = end; at < n; at++)
        if (data[at] != 0)
            return false;
    return true;
}

static bool fd_events(struct evstim_can *c, const uint8_t *data, size_t n)
{
    if (!is_sound_fd(c, data, n))
        return false;
    struct frame f = {.seq = data[4], .seq_bits = 255, .tick = evstim_unwrapped(u32(data), 32, c->near_tick)};
    if (!is_new(c, &f, data, n))
        return true;
    for (uint32_t i = 0; i < data[5]; i++) {
        uint32_t cell = u24(data + FD_HEAD_BYTES + CELL_BYTES * i), dt = cell >> 19;
        if (dt == SKIP) {
            f.tick += cell & 0x7FFFFu;
        } else {
            f.tick += dt;
            deliver(c, f.tick, cell);
        }
    }
    return true;
}

/* `count` and `more`, or the bound of the counter if the sum exceeds it: an overflow is undefined in C. */
static int32_t saturated(int32_t count, int64_t more)
{
    int64_t sum = count + more;
    return sum > INT32_MAX ? INT32_MAX : sum < INT32_MIN ? INT32_MIN : (int32_t)sum;
}

static bool epoch(struct evstim_can *c, const uint8_t *data, size_t n)
{
    if (n != CLASSIC_BYTES)
        return false;
    uint32_t time = u32(data), low = time & 0x3FFFFFFFu;
    uint16_t sent = u16(data + 4), dropped = u16(data + 6);
    uint16_t tick_us = ticks_us[time >> 30];
    uint64_t near = tick_us == c->tick_us ? c->near_tick : divided(near_us(c), tick_us);
    c->near_tick = c->timed || c->clocked ? evstim_unwrapped(low, 30, near) : low;
    c->tick_us = tick_us;
    if (c->timed) {
        c->lost = saturated(c->lost, (int16_t)(uint16_t)(sent - c->epoch_sent) - (int64_t)c->since_epoch);
        c->dropped += (uint16_t)(dropped - c->epoch_dropped);
    }
    c->epoch_sent = sent;
    c->epoch_dropped = dropped;
    c->since_epoch = 0;
    c->timed = true;
    return true;
}

static bool clock(struct evstim_can *c, const uint8_t *data, size_t n)
{
    if (n != CLASSIC_BYTES || data[7] >> 7 != 0)
        return false;
    c->near_tick = divided((uint64_t)u32(data + 4) << 32 | u32(data), c->tick_us);
    c->clocked = true;
    return true;
}

/* An edge on the external input, or a mark of the camera's own. */
static bool edge(struct evstim_can *c, const uint8_t *data, size_t n, bool own)
{
    if (n != CLASSIC_BYTES || data[4] < EVSTIM_RISING || data[4] > EVSTIM_PULSE)
        return false;
    struct evstim_edge edge = {
        .t_us = evstim_unwrapped(u32(data), 32, near_us(c)),
        .kind = data[4],
        .channel = data[5],
        .seq = u16(data + 6),
    };
    void (*deliver_to)(void *, const struct evstim_edge *) = own ? c->sink->mark : c->sink->edge;
    if (own)
        c->marks++;
    else
        c->edges++;
    if (deliver_to != NULL)
        deliver_to(c->sink->context, &edge);
    return true;
}

void evstim_can_frame(struct evstim_can *c, uint32_t identifier, bool fd, const uint8_t *data, size_t n)
{
    bool sound = true;
    if (identifier == c->ids.epoch)
        sound = epoch(c, data, n);
    else if (identifier == c->ids.clock)
        sound = clock(c, data, n);
    else if (identifier == c->ids.edges || identifier == c->ids.marks)
        sound = edge(c, data, n, identifier == c->ids.marks);
    else if (identifier == c->ids.events && !c->timed)
        c->before_epoch++;
    else if (identifier == c->ids.events)
        sound = fd ? fd_events(c, data, n) : classic_events(c, data, n);
    c->malformed += !sound;
}
