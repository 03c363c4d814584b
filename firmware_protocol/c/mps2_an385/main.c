/* A firmware that receives events on UART 0 and reports counts of them on UART 1.
 *
 * A letter on UART 1 selects the protocol of the line and restarts: 'c' telemetry in COBS (as after reset), 's' in
 * SLIP, 'k' in KISS, 'x' CSP in KISS, 'd' DAVIS346 words; a capital leaves out the digest, to time the decoder alone.
 * The answer, also to '?', is one line of name=value pairs, values in hexadecimal:
 *
 *   bytes    received on the line
 *   packets, missing: with events or edges
 *   events, edges
 *   dropped  events that the camera reports as dropped
 *   errors   everything that the decoder refused or found wrong
 *   digest   CRC-32 of the events as 13-byte records (u64 t, u16 x, u16 y, u8 on, little-endian), as evstim's
 *   ticks    time spent in the decoder, in ticks of the 25 MHz timer
 */
#include "board.h"
#include "evstim.h"

static struct {
    uint32_t bytes, events, edges, digest, ticks;
} counts;

static char carried; /* 'c', 's', 'k', 'x' or 'd' */
static bool with_digest;

static uint32_t crc32_byte(uint32_t crc, uint32_t byte)
{
    static const uint32_t table[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu,
    };
    crc ^= byte & 0xFFu;
    crc = crc >> 4 ^ table[crc & 15u];
    return crc >> 4 ^ table[crc & 15u];
}

static uint32_t crc32_u32(uint32_t crc, uint32_t value)
{
    for (int i = 0; i < 4; i++, value >>= 8)
        crc = crc32_byte(crc, value);
    return crc;
}

static void on_event(void *context, const struct evstim_event *event)
{
    (void)context;
    counts.events++;
    if (!with_digest)
        return;
    uint32_t crc = ~counts.digest;
    crc = crc32_u32(crc, (uint32_t)event->t_us);
    crc = crc32_u32(crc, (uint32_t)(event->t_us >> 32));
    crc = crc32_u32(crc, event->x | (uint32_t)event->y << 16);
    counts.digest = ~crc32_byte(crc, event->on);
}

static void on_edge(void *context, const struct evstim_edge *edge)
{
    (void)context;
    (void)edge;
    counts.edges++;
}

static const struct evstim_sink sink = {.event = on_event, .edge = on_edge};
static struct evstim_davis davis;
static struct evstim_telemetry telemetry;
static uint8_t packet[1024 + 26];

static enum evstim_framing framing(void)
{
    return carried == 's' ? EVSTIM_SLIP : carried == 'k' ? EVSTIM_KISS : carried == 'x' ? EVSTIM_CSP_KISS : EVSTIM_COBS;
}

static void start(char letter)
{
    with_digest = letter >= 'a';
    carried = with_digest ? letter : (char)(letter + 'a' - 'A');
    counts.bytes = counts.events = counts.edges = counts.digest = counts.ticks = 0;
    evstim_davis_init(&davis, 346, 260, false, &sink);
    evstim_telemetry_init(&telemetry, framing(), packet, sizeof packet, 346, 260, &sink);
}

static void take(uint8_t byte)
{
    uint32_t before = ticks_now();
    if (carried == 'd')
        evstim_davis_push(&davis, &byte, 1);
    else
        evstim_telemetry_push(&telemetry, &byte, 1);
    counts.ticks += ticks_now() - before;
    counts.bytes++;
}

static uint32_t errors(void)
{
    return davis.row_outside + davis.column_outside + davis.time_not_increasing + davis.unknown_special
           + davis.unknown_misc + telemetry.frames.malformed + telemetry.frames.too_long
           + telemetry.frames.wrong_crc + telemetry.refused + telemetry.disordered + telemetry.blocks.refused + telemetry.blocks.other_size;
}

static void print_value(const char *name, uint32_t value)
{
    while (*name)
        uart_write(CONSOLE, *name++);
    for (int shift = 28; shift >= 0; shift -= 4)
        uart_write(CONSOLE, "0123456789abcdef"[value >> shift & 15u]);
}

static void report(void)
{
    print_value("bytes=", counts.bytes);
    print_value(" packets=", telemetry.packets);
    print_value(" missing=", telemetry.missing);
    print_value(" events=", counts.events);
    print_value(" edges=", counts.edges);
    print_value(" dropped=", telemetry.blocks.dropped);
    print_value(" errors=", errors());
    print_value(" digest=", counts.digest);
    print_value(" ticks=", counts.ticks);
    uart_write(CONSOLE, '\n');
}

int main(void)
{
    board_init();
    start('c');
    for (;;) {
        if (uart_has_byte(LINE)) {
            take(uart_read(LINE));
        } else if (uart_has_byte(CONSOLE)) {
            char letter = (char)uart_read(CONSOLE);
            if (letter != '?')
                start(letter);
            report();
        }
    }
}
