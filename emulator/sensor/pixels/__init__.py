"""Pixels of a sensor: from light to threshold crossings with exact times.

In the order of a step: `array` takes the light frame; `workers` share the blocks of pixels between threads; `step` does
one block: `quiet_pass` finds the pixels that cannot fire, `candidates` solves those on smooth light, `march` all
others, in substeps; `refinement` solves undersampled ones again. `state` is the memory of the pixels, `curve` the
course of light within a step, `crossings` the result.
"""
