"""Signals that raise while a kernel runs: a program gets the exception, or numba's SystemError with it as the cause."""

import dataclasses
import signal
from contextlib import contextmanager

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor

WIDTH, HEIGHT = 640, 480


class Interrupted(Exception):
    """The exception of the signal's handler."""


@contextmanager
def interrupted_after(seconds):
    def handle(number, frame):
        raise Interrupted

    before = signal.signal(signal.SIGALRM, handle)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)  # again, where the first exception was lost in a destructor
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("preset", ["imx636", "davis346", "dvxplorer_micro"])
@pytest.mark.parametrize("seconds", [0.002, 0.01, 0.03, 0.07])
def test_a_signal_within_a_step_raises(preset, seconds):
    """The times lie in the pixels, the jitter and the read-out of some step; all of these are most of its time."""
    p = dataclasses.replace(PRESETS[preset], width=WIDTH, height=HEIGHT)
    sensor = Sensor(p, 1)
    sensor.warm_up()
    light = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    sensor.reset(LightFrame(0, light, np.zeros_like(light)))
    rng = np.random.default_rng(1)
    frames = [np.float32(0.5) + rng.random((HEIGHT, WIDTH), np.float32) for _ in range(2)]

    def steps_without_end():
        for t_ns in range(1_000_000, 10**12, 1_000_000):
            sensor.expose(LightFrame(t_ns, frames[t_ns // 1_000_000 % 2], None))

    with interrupted_after(seconds), pytest.raises((Interrupted, SystemError)) as caught:
        steps_without_end()
    assert isinstance(caught.value, Interrupted) or isinstance(caught.value.__cause__, Interrupted)
