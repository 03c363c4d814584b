"""Scenes in closed form for the independent check of interpolation: light and its rate, float64, a row of pixels.

Time is in steps and length in pixels, so a speed is pixels a step. A profile is "blurred", a Gaussian edge, or
"kinked", a linear ramp of the same rms: what averaging over a pixel makes of a sharp edge.
"""

import math

import numpy as np
from scipy.special import ndtr

PIXELS = 60


def profile(kind, rms):
    """Return the edge from 0 to 1 and its slope, as one function of the place."""
    if kind == "blurred":
        return lambda x: (ndtr(x / rms), np.exp(-0.5 * (x / rms) ** 2) / math.sqrt(2 * math.pi) / rms)
    half = rms * math.sqrt(3)
    return lambda x: (np.clip((x / half + 1) / 2, 0, 1), np.where(np.abs(x) < half, 0.5 / half, 0.0))


def _place(blur, speed):
    """Return the place of an edge that passes all pixels, as a function of time, and how many steps that takes."""
    way = 14 + 5 * blur
    return lambda t: speed * t[:, None] - way - 12 * np.linspace(-1, 1, PIXELS), 2 * way / speed


def edge(kind, blur, contrast, speed):
    """An edge between two flat surfaces."""
    rise, (place, steps) = profile(kind, blur), _place(blur, speed)

    def light(t):
        level, slope = rise(place(t))
        return 1 / contrast + (1 - 1 / contrast) * level, (1 - 1 / contrast) * slope * speed

    return light, steps


def shaded_edge(kind, blur, contrast, speed):
    """An edge between two surfaces whose light drifts by 5 % in 25 px: flat stretches that are not quite flat."""
    flat, steps = edge(kind, blur, contrast, speed)
    place, k = _place(blur, speed)[0], 2 * math.pi / 25

    def light(t):
        level, slope = flat(t)
        phase = k * place(t) + 1
        shade = np.exp(0.05 * np.sin(phase))
        return level * shade, (slope + level * 0.05 * k * speed * np.cos(phase)) * shade

    return light, steps


def thin_line(kind, blur, contrast, speed):
    """A bright line of 1 px."""
    rise, (place, steps) = profile(kind, blur), _place(blur, speed)

    def light(t):
        (up, up_slope), (down, down_slope) = rise(place(t) + 0.5), rise(place(t) - 0.5)
        return 1 / contrast + (1 - 1 / contrast) * (up - down), (1 - 1 / contrast) * (up_slope - down_slope) * speed

    return light, steps


def checkerboard(kind, blur, contrast, speed, side=12.0):
    """Squares of 12 px moving obliquely."""
    rise, k = profile(kind, blur), np.arange(PIXELS)
    vx, vy = speed * math.cos(0.3), speed * math.sin(0.3)

    def wave(x):
        near = (x + side / 2) % side - side / 2
        sign = 1 - 2 * (np.floor((x + side / 2) / side) % 2)
        edges = [(up, *rise(near - at)) for at, up in zip(side * np.arange(-2, 3), (1, -1, 1, -1, 1), strict=True)]
        return sign * (sum(up * 2 * level for up, level, _ in edges) - 1), sign * sum(up * 2 * s for up, _, s in edges)

    def light(t):
        x, x_slope = wave(k - vx * t[:, None])
        y, y_slope = wave((k * 0.618034 * side) % (2 * side) - vy * t[:, None])
        half = (1 - 1 / contrast) / 2
        return 1 - half + half * x * y, -half * (vx * x_slope * y + vy * x * y_slope)

    return light, 40 / speed


def body(kind, blur, contrast, speed):
    """A textured ellipse of 20 x 12 px that turns before a dim sky; its ends move at the given speed."""
    rise, turn = profile(kind, blur), speed / 20
    radius, start = 8 + 16 * ((np.arange(PIXELS) * 0.618034) % 1), 2.399963 * np.arange(PIXELS)

    def level(t):
        angle = start - turn * t[:, None]
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        far = np.sqrt((x / 20) ** 2 + (y / 12) ** 2)
        inside = (1 - far) * far / np.sqrt((x / 400) ** 2 + (y / 144) ** 2)
        texture = 0.75 + 0.25 * np.sin(2 * np.pi * x / 9 + 1) * np.sin(2 * np.pi * y / 7)
        return 1 / contrast + (1 - 1 / contrast) * rise(inside)[0] * texture

    def light(t):
        little = 1e-6
        return level(t), (level(t + little) - level(t - little)) / (2 * little)

    return light, math.pi / turn


def texture(_, blur, contrast, speed):
    """Four plane waves in log light, the shortest 6 blurs long, on a surface that passes."""
    waves = ((1, 0.4, 0, 0.22), (1.6, 1.9, 1, 0.22), (2.6, 3.1, 2, 0.28), (4.2, 5.2, 4, 0.28))
    radius, k = 3 + 57 * np.linspace(0, 1, PIXELS), np.arange(PIXELS)

    def light(t):
        x, y = radius * np.cos(2.4 * k) + speed * t[:, None], radius * np.sin(2.4 * k)
        log, slope = math.log(0.4), 0.0
        for longer, direction, phase, share in waves:
            wave, amplitude = 2 * math.pi / (6 * blur * longer), share * math.log(contrast) / 2
            angle = wave * (x * math.cos(direction) + y * math.sin(direction)) + phase
            log = log + amplitude * np.sin(angle)
            slope = slope + amplitude * wave * math.cos(direction) * speed * np.cos(angle)
        return np.exp(log), np.exp(log) * slope

    return light, min(60 * blur, 40) / speed


SCENES = {
    "edge": edge,
    "shaded edge": shaded_edge,
    "thin line": thin_line,
    "checkerboard": checkerboard,
    "body": body,
    "texture": texture,
}
CONTRASTS, BLURS_PX, SPEEDS_PX = (2, 6, 10), (0.3, 0.6, 1.0, 3.0), (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
