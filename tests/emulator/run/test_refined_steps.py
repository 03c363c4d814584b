"""Controlled steps count on refinement where the pixels' method uses the time derivative, and nowhere else."""

import dataclasses

import pytest

from emulator.rig.loading import load_rig
from emulator.run import assembly
from emulator.scene.checkerboard.checkerboard import Checkerboard
from transports.link.pacing import MonotonicClock


@pytest.mark.parametrize(("method", "refined"), [("hermite", True), ("line", False)])
def test_steps_count_on_refinement_where_the_method_has_the_derivative(monkeypatch, method, refined):
    asked = []
    monkeypatch.setattr(assembly, "ControlledSteps", lambda *figures: asked.append(figures))
    rig = load_rig("checkerboard")
    rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, method=method, tolerance_us=50.0))
    with Checkerboard(rig.scene, rig.camera.size) as scene:
        assembly.build_session(rig, scene, [], MonotonicClock())
    assert (asked[0][3] is not None) == refined
