/* The tutorial's flight code in C: the centroid of each 100 ms of events from standard input. */
#include <stdio.h>
#include <unistd.h>

#include "evstim.h"

struct centroid {
    uint64_t window;
    uint64_t x, y, count;
};

static void on_event(void *context, const struct evstim_event *event)
{
    struct centroid *sum = context;
    if (event->t_us / 100000 != sum->window) {
        if (sum->count)
            printf("x %.1f, y %.1f\n", (double)sum->x / sum->count, (double)sum->y / sum->count);
        fflush(stdout);
        *sum = (struct centroid){.window = event->t_us / 100000};
    }
    sum->x += event->x;
    sum->y += event->y;
    sum->count++;
}

int main(void)
{
    static uint8_t packet[1046], data[4096];
    static struct evstim_telemetry telemetry;
    struct centroid sum = {0};
    const struct evstim_sink sink = {.event = on_event, .context = &sum};
    ssize_t n;
    evstim_telemetry_init(&telemetry, EVSTIM_COBS, packet, sizeof packet, 346, 260, &sink);
    while ((n = read(0, data, sizeof data)) > 0)
        evstim_telemetry_push(&telemetry, data, n);
    return n < 0; /* the line was lost */
}
