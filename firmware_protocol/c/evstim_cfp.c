/* The CAN fragmentation protocol of CSP version 2 (CFP 2), the receiving side.
 *
 *   identifier  28..27 priority | 26..13 destination | 12..7 sender | 6..5 packet count | 4..2 frame count | 1 begin
 *               | 0 end
 *
 * The data of the first frame begin with the last four bytes of the CSP header; its first two are bits 28 to 13 of the
 * identifier. */
#include "evstim.h"

enum { END = 1, BEGIN = 2, FRAME_COUNT_BITS = 7, SENDER_BITS = 0x3F, NODE_BITS = 0x3FFF };
enum { HEADER_LEFT = 4, MOST_BYTES = 8 };

void evstim_cfp_init(struct evstim_cfp *cfp, uint16_t node, uint16_t peer, uint8_t *buffer, size_t capacity)
{
    *cfp = (struct evstim_cfp){.node = node, .peer = peer, .buffer = buffer, .capacity = capacity};
}

static bool append(struct evstim_cfp *c, const uint8_t *bytes, size_t n)
{
    if (n > c->capacity - c->length) {
        c->too_long++;
        c->length = 0;
        return false;
    }
    for (size_t i = 0; i < n; i++)
        c->buffer[c->length++] = bytes[i];
    return true;
}

static bool begin(struct evstim_cfp *c, uint32_t identifier, const uint8_t *data, size_t n)
{
    const uint8_t head[2] = {(uint8_t)(identifier >> 21), (uint8_t)(identifier >> 13)};
    if (c->length != 0)
        c->cut_short++;
    c->length = 0;
    if (n < HEADER_LEFT) {
        c->malformed++;
        return false;
    }
    c->connection = identifier >> 5;
    c->next = 1;
    return append(c, head, sizeof head) && append(c, data, n);
}

static bool go_on(struct evstim_cfp *c, uint32_t identifier, const uint8_t *data, size_t n)
{
    if (c->length == 0 || c->connection != identifier >> 5) {
        c->without_beginning++;
        return false;
    }
    if ((identifier >> 2 & FRAME_COUNT_BITS) != c->next) {
        c->disordered++;
        c->length = 0;
        return false;
    }
    c->next = (c->next + 1u) & FRAME_COUNT_BITS;
    return append(c, data, n);
}

size_t evstim_cfp_frame(struct evstim_cfp *c, uint32_t identifier, const uint8_t *data, size_t n)
{
    if ((identifier >> 13 & NODE_BITS) != c->peer || (identifier >> 7 & SENDER_BITS) != (c->node & SENDER_BITS))
        return 0;
    if (n > MOST_BYTES) {
        c->malformed++;
        return 0;
    }
    bool good = identifier & BEGIN ? begin(c, identifier, data, n) : go_on(c, identifier, data, n);
    if (!good || !(identifier & END))
        return 0;
    size_t length = c->length;
    c->length = 0;
    c->packets++;
    return length;
}
