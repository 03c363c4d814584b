/* Client for renderers: images for a rig of evstim whose scene is `kind = "external"`. C99 or C++11, and POSIX.
 *
 *     struct evstim_renderer_layout layout = {0};
 *     struct evstim_renderer renderer;
 *     struct evstim_renderer_image image;
 *     int code = evstim_renderer_open(&renderer, "127.0.0.1", 5560, &layout, 60.0);
 *     while (code == 0 && (code = evstim_renderer_next(&renderer, &image)) == 0) {
 *         ...                                        fill all planes of the image
 *         code = evstim_renderer_send(&renderer, &image, image.t_ns, NAN);
 *     }
 *     evstim_renderer_close(&renderer);
 *
 * All functions return 0, 1 at the end (EVSTIM_RENDERER_END), or a negative code; `renderer.reason` then has the text.
 * One file without a library: include it before system headers, or define _POSIX_C_SOURCE as 200112L or above. For
 * little-endian machines. A connection belongs to one thread.
 *
 * The messages are drawn in evstim's firmware_protocol/renderer.py. This file is in the public domain (CC0),
 * so that renderers under any licence can use it.
 */
#ifndef EVSTIM_RENDERER_H
#define EVSTIM_RENDERER_H

#if !defined(_POSIX_C_SOURCE) && !defined(_GNU_SOURCE) && !defined(__APPLE__)
#define _POSIX_C_SOURCE 200112L
#endif

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "evstim_renderer.h needs a little-endian machine: numbers and pixels are sent as they lie in memory"
#endif

#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

#ifdef __cplusplus
extern "C" {
#endif

/* ---- Images and camera ------------------------------------------------------------------------------------------- */

enum evstim_renderer_code {
    EVSTIM_RENDERER_GOOD = 0,
    EVSTIM_RENDERER_END = 1,       /* evstim ended the connection, without a reason */
    EVSTIM_RENDERER_REFUSED = -1,  /* evstim refused this renderer or one of its images */
    EVSTIM_RENDERER_SYSTEM = -2,   /* a call of the system failed: no connection, no memory */
    EVSTIM_RENDERER_MESSAGE = -3,  /* the other side sends something else than version 1 of the messages */
    EVSTIM_RENDERER_ARGUMENT = -4, /* an argument is not valid */
};

enum evstim_renderer_layers { EVSTIM_RENDERER_MOTION = 1, EVSTIM_RENDERER_DEPTH = 2, EVSTIM_RENDERER_RATE = 4 };

enum evstim_renderer_levels { EVSTIM_RENDERER_FLOAT32 = 0, EVSTIM_RENDERER_U8 = 1, EVSTIM_RENDERER_U16 = 2 };

enum evstim_renderer_response { EVSTIM_RENDERER_LINEAR = 0, EVSTIM_RENDERER_SRGB = 1 };

/* Time of an image that the renderer chooses: any later than the last one. */
#define EVSTIM_RENDERER_ANY_TIME INT64_MIN

/* The images that a renderer gives. All zeros: float32 light alone, through the connection. */
struct evstim_renderer_layout {
    unsigned layers;   /* sum of enum evstim_renderer_layers */
    unsigned levels;   /* enum evstim_renderer_levels */
    unsigned response; /* enum evstim_renderer_response; float32 is linear */
    unsigned white;    /* level of white of u8 and u16; 0 for float32 */
    int shared;        /* 1: through shared memory, on one machine; 0: through the connection */
    const char *name;  /* of the renderer, for evstim's summary, at most 64 octets; or NULL */
};

/* A connection, and the camera to draw for: no distortion, boresight in the middle of the image. */
struct evstim_renderer {
    uint32_t width, height; /* px */
    double focal_px;        /* focal length over pixel pitch */
    int64_t period_ns;      /* from one image to the next; 0: the renderer gives the times */
    int has_pose;           /* 1: each image has the pose of the camera */
    char reason[1001];      /* of the last code that was negative; empty before */

    /* For the functions below. */
    struct evstim_renderer_layout layout;
    int socket, shared;
    uint32_t slots;
    size_t slot_octets, memory_octets;
    unsigned char *memory;
};

/* One requested image. Each plane is to be filled completely, row 0 on top; planes that the layout lacks are NULL. */
struct evstim_renderer_image {
    int64_t t_ns;                  /* stream time, or EVSTIM_RENDERER_ANY_TIME */
    double position_m[3];          /* of the camera in the world; NaN without a pose */
    double q_world_from_camera[4]; /* scalar first, axes of OpenCV (x right, y down); NaN without a pose */
    void *light;                   /* float, uint8_t or uint16_t [height][width]: radiance over that of white */
    float *motion;                 /* [height][width][2]: velocity of the visible point, px/s, to the right and down */
    float *depth;                  /* [height][width]: m along the boresight; infinite for the sky */
    float *rate;                   /* [height][width]: time derivative of the light, 1/s */
    uint64_t number;               /* of the request */
    uint32_t slot;
};

/* ---- Internal functions ------------------------------------------------------------------------------------------ */

#ifdef MSG_NOSIGNAL
#define EVSTIM_RENDERER_SEND_FLAGS MSG_NOSIGNAL
#else
#define EVSTIM_RENDERER_SEND_FLAGS 0
#endif

enum { EVSTIM_R_HELLO = 1, EVSTIM_R_CAMERA, EVSTIM_R_READY, EVSTIM_R_DRAW, EVSTIM_R_IMAGE, EVSTIM_R_END };

/* Add a text to the reason, as much of it as there is room for. */
static inline void evstim_r_add(struct evstim_renderer *r, const char *text)
{
    size_t used = strlen(r->reason), room = sizeof r->reason - 1 - used, count = strlen(text);
    count = count < room ? count : room;
    memcpy(r->reason + used, text, count);
    r->reason[used + count] = '\0';
}

static inline int evstim_r_fail(struct evstim_renderer *r, int code, const char *what, const char *why)
{
    r->reason[0] = '\0';
    evstim_r_add(r, what);
    if (why != NULL) {
        evstim_r_add(r, ": ");
        evstim_r_add(r, why);
    }
    return code;
}

static inline int evstim_r_system(struct evstim_renderer *r, const char *what)
{
    return evstim_r_fail(r, EVSTIM_RENDERER_SYSTEM, what, strerror(errno));
}

/* Send all octets. A closed connection is no error here: the reason, if there is one, is the next message. */
static inline int evstim_r_deliver(struct evstim_renderer *r, const unsigned char *octets, size_t count)
{
    while (count > 0) {
        ssize_t sent = send(r->socket, octets, count, EVSTIM_RENDERER_SEND_FLAGS);
        if (sent < 0 && errno == EINTR)
            continue;
        if (sent < 0 && (errno == EPIPE || errno == ECONNRESET))
            return EVSTIM_RENDERER_GOOD;
        if (sent < 0)
            return evstim_r_system(r, "a message could not be sent");
        octets += sent;
        count -= (size_t)sent;
    }
    return EVSTIM_RENDERER_GOOD;
}

/* Send header and body of at most 80 octets; `more` octets follow them. */
static inline int evstim_r_message(struct evstim_renderer *r, uint16_t type, const void *body, size_t count, size_t more)
{
    unsigned char octets[16 + 80];
    uint16_t version = 1;
    uint64_t length = (uint64_t)count + more;
    memcpy(octets, "EVSR", 4);
    memcpy(octets + 4, &type, 2);
    memcpy(octets + 6, &version, 2);
    memcpy(octets + 8, &length, 8);
    if (count > 0)
        memcpy(octets + 16, body, count);
    return evstim_r_deliver(r, octets, 16 + count);
}

static inline int evstim_r_read(struct evstim_renderer *r, void *target, size_t count)
{
    unsigned char *octets = (unsigned char *)target;
    while (count > 0) {
        ssize_t got = recv(r->socket, octets, count, 0);
        if (got < 0 && errno == EINTR)
            continue;
        if (got == 0 || (got < 0 && errno == ECONNRESET))
            return EVSTIM_RENDERER_END;
        if (got < 0)
            return evstim_r_system(r, "a message could not be read");
        octets += got;
        count -= (size_t)got;
    }
    return EVSTIM_RENDERER_GOOD;
}

/* Read an END of `count` octets. */
static inline int evstim_r_ended(struct evstim_renderer *r, size_t count)
{
    char text[1001];
    if (count > 1000)
        return evstim_r_fail(r, EVSTIM_RENDERER_MESSAGE, "the reason of END is longer than 1000 octets", NULL);
    if (count == 0 || evstim_r_read(r, text, count) != EVSTIM_RENDERER_GOOD)
        return EVSTIM_RENDERER_END;
    text[count] = '\0';
    return evstim_r_fail(r, EVSTIM_RENDERER_REFUSED, text, NULL);
}

/* Read a message of `type`, of `least` to `most` octets, into `body`. */
static inline int evstim_r_expect(
    struct evstim_renderer *r, uint16_t type, unsigned char *body, size_t least, size_t most, size_t *count)
{
    unsigned char header[16];
    uint16_t found, version;
    uint64_t length;
    int code = evstim_r_read(r, header, sizeof header);
    if (code != EVSTIM_RENDERER_GOOD)
        return code;
    memcpy(&found, header + 4, 2);
    memcpy(&version, header + 6, 2);
    memcpy(&length, header + 8, 8);
    if (memcmp(header, "EVSR", 4) != 0 || version != 1)
        return evstim_r_fail(r, EVSTIM_RENDERER_MESSAGE, "the other side is no evstim of this version", NULL);
    if (found == EVSTIM_R_END)
        return evstim_r_ended(r, length > 1000 ? 1001 : (size_t)length);
    if (found != type || length < least || length > most)
        return evstim_r_fail(r, EVSTIM_RENDERER_MESSAGE, "a message has a wrong type or length", NULL);
    *count = (size_t)length;
    return evstim_r_read(r, body, *count);
}

static inline double evstim_r_seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Connect to the first of the addresses that accepts; return whether one did. */
static inline int evstim_r_try(struct evstim_renderer *r, const struct addrinfo *list)
{
    for (; list != NULL; list = list->ai_next) {
        int kept;
        r->socket = socket(list->ai_family, list->ai_socktype, list->ai_protocol);
        if (r->socket >= 0 && connect(r->socket, list->ai_addr, list->ai_addrlen) == 0)
            return 1;
        kept = errno;
        if (r->socket >= 0)
            close(r->socket);
        r->socket = -1;
        errno = kept;
    }
    return 0;
}

static inline int evstim_r_connect(struct evstim_renderer *r, const char *host, unsigned port, double wait_seconds)
{
    const struct timespec pause = {0, 50000000};
    double until = evstim_r_seconds() + wait_seconds;
    struct addrinfo hints, *list = NULL;
    char service[12];
    int failed, on = 1, connected;
    memset(&hints, 0, sizeof hints);
    hints.ai_socktype = SOCK_STREAM;
    snprintf(service, sizeof service, "%u", port);
    failed = getaddrinfo(host, service, &hints, &list);
    if (failed != 0)
        return evstim_r_fail(r, EVSTIM_RENDERER_SYSTEM, "the host is not known", gai_strerror(failed));
    while (!(connected = evstim_r_try(r, list)) && errno == ECONNREFUSED && evstim_r_seconds() < until)
        nanosleep(&pause, NULL);
    if (!connected)
        evstim_r_system(r, "evstim cannot be reached");
    freeaddrinfo(list);
    if (!connected)
        return EVSTIM_RENDERER_SYSTEM;
    setsockopt(r->socket, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
#ifdef SO_NOSIGPIPE
    setsockopt(r->socket, SOL_SOCKET, SO_NOSIGPIPE, &on, sizeof on);
#endif
    return EVSTIM_RENDERER_GOOD;
}

/* Octets of a plane of numbers of `size` octets, filled to a multiple of 64. */
static inline size_t evstim_r_plane(const struct evstim_renderer *r, size_t size)
{
    return ((size_t)r->width * r->height * size + 63) / 64 * 64;
}

/* Set the planes of an image whose slot begins at `first`, and return the octets of a slot. */
static inline size_t evstim_r_planes(
    const struct evstim_renderer *r, unsigned char *first, struct evstim_renderer_image *image)
{
    static const size_t sizes[3] = {4, 1, 2};
    size_t offset = evstim_r_plane(r, sizes[r->layout.levels]);
    image->light = first;
    if (r->layout.layers & EVSTIM_RENDERER_MOTION) {
        image->motion = (float *)(void *)(first + offset);
        offset += evstim_r_plane(r, 8);
    }
    if (r->layout.layers & EVSTIM_RENDERER_DEPTH) {
        image->depth = (float *)(void *)(first + offset);
        offset += evstim_r_plane(r, 4);
    }
    if (r->layout.layers & EVSTIM_RENDERER_RATE) {
        image->rate = (float *)(void *)(first + offset);
        offset += evstim_r_plane(r, 4);
    }
    return offset;
}

/* Map the file of the shared memory. */
static inline int evstim_r_map(struct evstim_renderer *r, const char *path)
{
    struct stat status;
    void *memory = MAP_FAILED;
    int file = open(path, O_RDWR);
    if (file < 0)
        return evstim_r_system(r, "the shared memory cannot be opened (is evstim in this machine and container?)");
    r->memory_octets = r->slots * r->slot_octets;
    if (fstat(file, &status) == 0 && status.st_size == (off_t)r->memory_octets) /* else another program's file */
        memory = mmap(NULL, r->memory_octets, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    close(file);
    if (memory == MAP_FAILED)
        return evstim_r_fail(r, EVSTIM_RENDERER_SYSTEM, "the shared memory cannot be mapped", path);
    r->memory = (unsigned char *)memory;
    return EVSTIM_RENDERER_GOOD;
}

/* Prepare the memory of the slots; one serves all where the pixels go through the connection. */
static inline int evstim_r_memory(struct evstim_renderer *r, const char *path)
{
    r->shared = path[0] != '\0';
    if (r->shared)
        return evstim_r_map(r, path);
    r->memory = (unsigned char *)calloc(1, r->slot_octets);
    return r->memory != NULL ? EVSTIM_RENDERER_GOOD : evstim_r_system(r, "no memory for an image");
}

static inline int evstim_r_hello(struct evstim_renderer *r)
{
    const struct evstim_renderer_layout *layout = &r->layout;
    unsigned char body[80];
    uint32_t layers = layout->layers, carrier = layout->shared != 0;
    uint16_t white = (uint16_t)layout->white;
    size_t length = layout->name != NULL ? strlen(layout->name) : 0;
    memset(body, 0, sizeof body);
    memcpy(body, &layers, 4);
    body[4] = (unsigned char)layout->levels;
    body[5] = (unsigned char)layout->response;
    memcpy(body + 6, &white, 2);
    memcpy(body + 8, &carrier, 4);
    if (length > 0)
        memcpy(body + 16, layout->name, length < 64 ? length : 64);
    return evstim_r_message(r, EVSTIM_R_HELLO, body, sizeof body, 0);
}

static inline int evstim_r_camera(struct evstim_renderer *r)
{
    unsigned char body[40 + 1024];
    struct evstim_renderer_image image;
    uint32_t has_pose;
    uint64_t octets;
    size_t count = 0;
    int code = evstim_r_expect(r, EVSTIM_R_CAMERA, body, 40, sizeof body - 1, &count);
    if (code == EVSTIM_RENDERER_END)
        return evstim_r_fail(r, EVSTIM_RENDERER_REFUSED, "evstim ended the connection", NULL);
    if (code != EVSTIM_RENDERER_GOOD)
        return code;
    body[count] = '\0';
    memcpy(&r->width, body, 4);
    memcpy(&r->height, body + 4, 4);
    memcpy(&r->focal_px, body + 8, 8);
    memcpy(&r->period_ns, body + 16, 8);
    memcpy(&r->slots, body + 24, 4);
    memcpy(&has_pose, body + 28, 4);
    memcpy(&octets, body + 32, 8);
    r->has_pose = has_pose != 0;
    if (r->width - 1u > 65534u || r->height - 1u > 65534u || r->slots - 1u > 65534u)
        return evstim_r_fail(r, EVSTIM_RENDERER_MESSAGE, "the camera has no size, or no slots", NULL);
    if (octets == 0 || octets > SIZE_MAX / r->slots)
        return evstim_r_fail(r, EVSTIM_RENDERER_MESSAGE, "the slots have a size that no memory has", NULL);
    r->slot_octets = (size_t)octets;
    code = evstim_r_memory(r, (const char *)body + 40);
    if (code == EVSTIM_RENDERER_GOOD && evstim_r_planes(r, r->memory, &image) != r->slot_octets)
        return evstim_r_fail(r, EVSTIM_RENDERER_MESSAGE, "the slots have another size than the images", NULL);
    return code;
}

/* ---- Functions --------------------------------------------------------------------------------------------------- */

/* Disconnect and give the memory back; a second call does nothing. The planes of all images end here. */
static inline void evstim_renderer_close(struct evstim_renderer *renderer)
{
    if (renderer->socket >= 0)
        close(renderer->socket);
    renderer->socket = -1;
    if (renderer->memory != NULL && renderer->shared)
        munmap(renderer->memory, renderer->memory_octets);
    else
        free(renderer->memory);
    renderer->memory = NULL;
}

/* Connect to evstim, which is waited for, and prepare the images. After an error nothing is left open. */
static inline int evstim_renderer_open(struct evstim_renderer *renderer, const char *host, unsigned port,
    const struct evstim_renderer_layout *layout, double wait_seconds)
{
    int code;
    memset(renderer, 0, sizeof *renderer);
    renderer->socket = -1;
    renderer->layout = *layout;
    if (layout->levels > 2 || layout->response > 1 || layout->layers > 7 || layout->white > 65535)
        return evstim_r_fail(renderer, EVSTIM_RENDERER_ARGUMENT, "the layout has a value out of its range", NULL);
    code = evstim_r_connect(renderer, host, port, wait_seconds);
    if (code == EVSTIM_RENDERER_GOOD)
        code = evstim_r_hello(renderer);
    if (code == EVSTIM_RENDERER_GOOD)
        code = evstim_r_camera(renderer);
    if (code == EVSTIM_RENDERER_GOOD)
        code = evstim_r_message(renderer, EVSTIM_R_READY, NULL, 0, 0);
    renderer->layout.name = NULL; /* the caller's text need not stay */
    if (code != EVSTIM_RENDERER_GOOD)
        evstim_renderer_close(renderer);
    return code;
}

/* Wait for the next request. The planes of `image` are valid until it is sent. */
static inline int evstim_renderer_next(struct evstim_renderer *renderer, struct evstim_renderer_image *image)
{
    unsigned char body[80];
    size_t count = 0;
    int code;
    memset(image, 0, sizeof *image);
    if (renderer->socket < 0)
        return evstim_r_fail(renderer, EVSTIM_RENDERER_ARGUMENT, "the connection is not open", NULL);
    code = evstim_r_expect(renderer, EVSTIM_R_DRAW, body, sizeof body, sizeof body, &count);
    if (code != EVSTIM_RENDERER_GOOD)
        return code;
    memcpy(&image->number, body, 8);
    memcpy(&image->t_ns, body + 8, 8);
    memcpy(&image->slot, body + 16, 4);
    memcpy(image->position_m, body + 24, 24);
    memcpy(image->q_world_from_camera, body + 48, 32);
    if (image->slot >= renderer->slots)
        return evstim_r_fail(renderer, EVSTIM_RENDERER_MESSAGE, "a request has a slot that does not exist", NULL);
    evstim_r_planes(renderer, renderer->memory + (renderer->shared ? image->slot * renderer->slot_octets : 0), image);
    return EVSTIM_RENDERER_GOOD;
}

/* Send an image of `t_ns`: image->t_ns, or the renderer's choice where that is EVSTIM_RENDERER_ANY_TIME.
 * `motion_bound_px_s` bounds the motion of all its points; NaN where that is not known. */
static inline int evstim_renderer_send(struct evstim_renderer *renderer, const struct evstim_renderer_image *image,
    int64_t t_ns, double motion_bound_px_s)
{
    unsigned char body[24];
    size_t pixels = renderer->shared ? 0 : renderer->slot_octets;
    int code;
    if (renderer->socket < 0)
        return evstim_r_fail(renderer, EVSTIM_RENDERER_ARGUMENT, "the connection is not open", NULL);
    if (t_ns == EVSTIM_RENDERER_ANY_TIME)
        return evstim_r_fail(renderer, EVSTIM_RENDERER_ARGUMENT, "this rig leaves the times to the renderer", NULL);
    memcpy(body, &image->number, 8);
    memcpy(body + 8, &t_ns, 8);
    memcpy(body + 16, &motion_bound_px_s, 8);
    code = evstim_r_message(renderer, EVSTIM_R_IMAGE, body, sizeof body, pixels);
    return code != EVSTIM_RENDERER_GOOD ? code : evstim_r_deliver(renderer, renderer->memory, pixels);
}

/* Report the end of the scene (`reason` NULL or ""), or the reason why no more images can be drawn, and disconnect. */
static inline int evstim_renderer_end(struct evstim_renderer *renderer, const char *reason)
{
    unsigned char header[16] = {'E', 'V', 'S', 'R', EVSTIM_R_END, 0, 1, 0};
    size_t count = reason != NULL ? strlen(reason) : 0;
    uint64_t length;
    int code;
    if (renderer->socket < 0)
        return evstim_r_fail(renderer, EVSTIM_RENDERER_ARGUMENT, "the connection is not open", NULL);
    length = count = count < 1000 ? count : 1000;
    memcpy(header + 8, &length, 8);
    code = evstim_r_deliver(renderer, header, sizeof header);
    if (code == EVSTIM_RENDERER_GOOD)
        code = evstim_r_deliver(renderer, (const unsigned char *)reason, count);
    evstim_renderer_close(renderer);
    return code;
}

#ifdef __cplusplus
}
#endif

#endif
