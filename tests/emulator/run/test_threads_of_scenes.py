"""`run.threads`: the number of threads that draw and blur, which changes no light."""

import dataclasses

import numpy as np
import pytest

import emulator.optics.through
import emulator.raster.renderer
from emulator.rig.loading import load_rig
from emulator.run.assembly import build_scene
from emulator.threads import ThreadPool, available_threads

SIZE = (64, 48)


def drawn(name, threads):
    rig = load_rig(name)
    rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, threads=threads))
    light, rate = np.zeros((2, *SIZE[::-1]), np.float32)
    with build_scene(rig, SIZE) as scene:
        scene.light_and_rate(1_000_000, light, rate)
    return light, rate


@pytest.fixture
def pools(monkeypatch):
    """The numbers of threads of the pools of the renderer and of the blur, in the order in which they are made."""
    numbers = []

    class Noted(ThreadPool):
        def __init__(self, threads):
            numbers.append(threads)
            super().__init__(threads)

    monkeypatch.setattr(emulator.raster.renderer, "ThreadPool", Noted)
    monkeypatch.setattr(emulator.optics.through, "ThreadPool", Noted)
    return numbers


@pytest.mark.sampled
@pytest.mark.parametrize(("name", "chosen"), [("eros", 1), ("malapert", available_threads())])
def test_threads_of_a_run_draw_and_blur_and_change_no_light(pools, name, chosen):
    alone = drawn(name, 1)
    together = drawn(name, 3)
    drawn(name, 0)
    assert pools == [1, 1, 3, 3, chosen, available_threads()]
    assert alone[0].any()
    np.testing.assert_array_equal(together, alone)
