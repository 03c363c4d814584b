"""Odd behaviour of drivers that the camera model allows for, each with its story.

**neuromorphic_drivers loses order when data flow at once.** Versions 0.16 to 0.18 start the sensor, then submit 32
bulk transfers one after another, resubmit each as soon as it finishes, and take completions in ring order. If a
transfer finishes while the others are still being submitted, buffers are swapped or lost: 6 of 16 openings lost or
reordered events of a 50 000-event stream in a slow guest; with data held back for 0.3 s, 16 of 16 were exact. A real
camera races too, but nobody compares its events with a truth. So the model stays silent for START_DELAY_US of stream
time after the run gate opens, and anew when the DVS is switched on, unless the host has read by then: in the middle of
a stream the DVS can be switched off and on without a silence. A timestamp reset ends the silence at once:
neuromorphic_drivers never sends one, and the drivers that do (libcaer, dv-processing) have all their transfers queued
by then, the latter waiting 5 s for the reset.

**neuromorphic_drivers ignores the number of steps in a wrap word** and always adds 32 768 us (0.18.2). The encoder
sends wraps one by one, and uses words of many steps only when the host has not read for so long that single ones do
not fit; libcaer and dv-processing then keep the right time, neuromorphic_drivers falls behind, as it would with a real
camera.
"""

from __future__ import annotations

__all__ = ["START_DELAY_US"]

START_DELAY_US = 300_000
