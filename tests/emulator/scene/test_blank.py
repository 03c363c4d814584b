"""A scene with nothing to see says that nothing changes, once its arrays hold darkness."""

import numpy as np

from emulator.scene.kind import Blank


def test_arrays_are_cleared_once_and_nothing_changes_from_then_on():
    scene = Blank((6, 4))
    light, rate = np.ones((4, 6), np.float32), np.ones((4, 6), np.float32)
    scene.light_and_rate(0, light, rate)
    assert scene.changed is None
    assert not light.any()
    assert not rate.any()
    scene.light_and_rate(1_000_000, light, rate)
    assert scene.changed is not None
    assert scene.changed.empty


def test_other_arrays_are_cleared_and_may_have_changed():
    scene = Blank((6, 4))
    light, rate = np.ones((4, 6), np.float32), np.ones((4, 6), np.float32)
    scene.light_and_rate(0, light, rate)
    other = np.ones((4, 6), np.float32)
    scene.light(1_000_000, other)
    assert scene.changed is None
    assert not other.any()
    scene.light(2_000_000, light)
    assert scene.changed is None
