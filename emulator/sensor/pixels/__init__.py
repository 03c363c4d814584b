"""Pixels of a sensor: from light to threshold crossings with exact times.

In the order of a step: `array` takes the light frame; `step` shares the blocks of pixels between threads, and in each
block `quiet_pass` finds the pixels that cannot fire, `candidates` solves those on smooth light, `march` all others, in
substeps, and with noise `noisy` both; `refinement` solves undersampled ones again. A pixel's light, filter and
thresholds are in `state`; `curve` and `receptor` are the laws of its light and of its filter within a step. An event
gets its time in `_fire` of both, by `event_time`. A bias acts in `array.PixelArray.adjust`, which changes thresholds
and leaks of the pixels, and in `_constants`, which makes the other parameters the constants of each step.
"""
