"""Effects and parts in a report: those of the plan, and of nothing else."""

import dataclasses
import math

import pytest

from emulator.plan.costs import EFFECTS
from emulator.rig.loading import load_rig
from emulator.run.report.modelled import modelled
from emulator.scene.kind import Blank


def rig_with(**run):
    rig = load_rig("checkerboard")
    return dataclasses.replace(rig, run=dataclasses.replace(rig.run, **run))


class Ramp(Blank):
    """Light that grows by a factor e in each second."""

    notes = ("the light only grows",)

    def light(self, t_ns, out):
        out.fill(math.exp(t_ns * 1e-9))

    def light_and_rate(self, t_ns, light, rate):
        light.fill(math.exp(t_ns * 1e-9))
        rate.fill(math.exp(t_ns * 1e-9))


class Untouched(Blank):
    """A scene that may not be drawn."""

    def light(self, t_ns, out):
        raise AssertionError


def test_every_effect_is_named_once_whatever_the_rig():
    for run in ({}, {"tolerance_us": 100.0}):
        found = modelled(rig_with(**run), Ramp((346, 260)))
        assert sorted(effect.effect for effect in found.effects) == sorted(EFFECTS)


def test_without_a_tolerance_nothing_is_left_out_by_choice():
    found = modelled(rig_with(), Ramp((346, 260)))
    assert found.tolerance_us is None
    assert {one.why.split(":")[0] for one in found.effects if one.state == "left out"} <= {"not in the chosen grade"}
    assert found.probed
    assert "the light only grows" in found.notes


def test_with_a_tolerance_the_effects_left_out_are_those_that_the_sensor_lacks():
    rig = rig_with(tolerance_us=1e6, tolerated_wrong_share=0.5)
    found = modelled(rig, Ramp((346, 260)))
    left = {one.effect for one in found.effects if one.state == "left out"}
    assert {"leak", "mismatch", "refractory period", "noise"} <= left
    assert (found.tolerance_us, found.tolerated_wrong_share) == (1e6, 0.5)
    assert "dark current" in {one.effect for one in found.effects if one.state == "modelled"}


@pytest.mark.parametrize("is_driven", [False, True])
def test_frames_of_another_program_are_not_drawn_for_the_plan(is_driven):
    rig = rig_with()
    if not is_driven:
        rig = dataclasses.replace(rig, scene=type("External", (), {"kind": "external"})())
    found = modelled(rig, Untouched((346, 260)), is_driven=is_driven)
    assert not found.probed
    assert {(one.time_error_us, one.wrong_share) for one in found.effects} == {(None, None)}
    assert sorted(effect.effect for effect in found.effects) == sorted(EFFECTS)


def test_a_recording_has_no_effect_of_a_sensor():
    rig = load_rig("checkerboard")
    played = dataclasses.replace(rig, scene=type("Played", (), {"kind": "recording"})())
    found = modelled(played, Untouched((346, 260)))
    assert not found.effects
    assert "no pixel is modelled" in found.parts[0].how
