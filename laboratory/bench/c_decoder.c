/* Times the C decoder on this machine: c_decoder MODE FILE REPEATS.
 *
 * MODE 'b': FILE holds blocks, each behind a u32 with its length; 'c', 'k', 'x': telemetry in COBS, in KISS, CSP in
 * KISS; 'd': DAVIS words. Prints the events of one pass, a sum over their fields, and then the nanoseconds of processor
 * time of each pass. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "evstim.h"

static uint64_t events, sum;

static void on_event(void *context, const struct evstim_event *event)
{
    (void)context;
    events++;
    sum += event->t_us * 3 + event->x * 5u + event->y * 7u + event->on;
}

static const struct evstim_sink sink = {.event = on_event};

static void decode_blocks(const uint8_t *bytes, size_t n)
{
    struct evstim_blocks blocks;
    evstim_blocks_init(&blocks, 346, 260, &sink);
    for (size_t at = 0; at < n;) {
        uint32_t length;
        memcpy(&length, bytes + at, sizeof length);
        evstim_block(&blocks, bytes + at + sizeof length, length, 0);
        at += sizeof length + length;
    }
}

static void decode_telemetry(enum evstim_framing framing, const uint8_t *bytes, size_t n)
{
    static uint8_t packet[1050];
    struct evstim_telemetry telemetry;
    evstim_telemetry_init(&telemetry, framing, packet, sizeof packet, 346, 260, &sink);
    evstim_telemetry_push(&telemetry, bytes, n);
}

static void decode_line(const uint8_t *bytes, size_t n)
{
    decode_telemetry(EVSTIM_COBS, bytes, n);
}

static void decode_kiss(const uint8_t *bytes, size_t n)
{
    decode_telemetry(EVSTIM_KISS, bytes, n);
}

static void decode_csp(const uint8_t *bytes, size_t n)
{
    decode_telemetry(EVSTIM_CSP_KISS, bytes, n);
}

static void decode_words(const uint8_t *bytes, size_t n)
{
    struct evstim_davis davis;
    evstim_davis_init(&davis, 346, 260, false, &sink);
    evstim_davis_push(&davis, bytes, n);
}

static int64_t spent_ns(void)
{
    struct timespec time;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
    return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

static uint8_t *read_all(const char *path, size_t *n)
{
    FILE *file = fopen(path, "rb");
    if (file == NULL || fseek(file, 0, SEEK_END) != 0)
        exit(1);
    *n = (size_t)ftell(file);
    rewind(file);
    uint8_t *bytes = malloc(*n);
    if (bytes == NULL || fread(bytes, 1, *n, file) != *n)
        exit(1);
    fclose(file);
    return bytes;
}

int main(int argc, char **argv)
{
    size_t n;
    if (argc != 4)
        return 2;
    void (*decode)(const uint8_t *, size_t) = argv[1][0] == 'b'   ? decode_blocks
                                              : argv[1][0] == 'c' ? decode_line
                                              : argv[1][0] == 'k' ? decode_kiss
                                              : argv[1][0] == 'x' ? decode_csp
                                                                  : decode_words;
    uint8_t *bytes = read_all(argv[2], &n);
    decode(bytes, n);
    printf("%" PRIu64 " %" PRIu64 "\n", events, sum);
    for (int i = atoi(argv[3]); i > 0; i--) {
        int64_t start = spent_ns();
        decode(bytes, n);
        printf("%" PRId64 "\n", spent_ns() - start);
    }
    free(bytes);
    return 0;
}
