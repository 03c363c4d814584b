/* Draw each image with its time, in ms, as light: PORT SHARED LEVELS COUNT REASON; END after COUNT images. */
#include "evstim_renderer.h"

#include <math.h>

static void fill(const struct evstim_renderer *renderer, const struct evstim_renderer_image *image, int64_t t_ms)
{
    size_t k, pixels = (size_t)renderer->width * renderer->height;
    for (k = 0; k < pixels; k++) {
        if (renderer->layout.levels == EVSTIM_RENDERER_FLOAT32)
            ((float *)image->light)[k] = (float)t_ms;
        else
            ((uint8_t *)image->light)[k] = (uint8_t)t_ms;
        image->motion[2 * k] = 3.0f;
        image->motion[2 * k + 1] = renderer->has_pose ? (float)image->position_m[2] : -2.0f;
        image->rate[k] = 0.5f;
    }
}

int main(int count, char **arguments)
{
    struct evstim_renderer_layout layout;
    struct evstim_renderer renderer;
    struct evstim_renderer_image image;
    int code, drawn = 0;
    if (count != 6)
        return 2;
    memset(&layout, 0, sizeof layout);
    layout.layers = EVSTIM_RENDERER_MOTION | EVSTIM_RENDERER_RATE;
    layout.shared = atoi(arguments[2]);
    layout.levels = (unsigned)atoi(arguments[3]);
    layout.white = layout.levels == EVSTIM_RENDERER_U8 ? 255 : 0;
    layout.name = "a test in C";
    code = evstim_renderer_open(&renderer, "127.0.0.1", (unsigned)atoi(arguments[1]), &layout, 0.0);
    while (code == 0 && (code = evstim_renderer_next(&renderer, &image)) == 0) {
        int64_t t_ns = image.t_ns == EVSTIM_RENDERER_ANY_TIME ? drawn * INT64_C(7000000) : image.t_ns;
        if (drawn++ == atoi(arguments[4])) {
            code = evstim_renderer_end(&renderer, arguments[5]);
            break;
        }
        fill(&renderer, &image, t_ns / 1000000);
        code = evstim_renderer_send(&renderer, &image, t_ns, NAN);
    }
    printf("%d %s", code, renderer.reason);
    evstim_renderer_close(&renderer);
    return 0;
}
