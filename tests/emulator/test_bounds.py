"""Effects kept or dropped by their bounds."""

import dataclasses
import math

import pytest

from emulator.bounds import Tolerance, decide, without
from emulator.probe import Probe
from emulator.sensor.effects import DefectParameters, JitterParameters, NoiseParameters, RadiationParameters
from emulator.sensor.presets import PRESETS

SCENE = Probe(
    contrast_rate=20.0,
    bend=50.0,
    line_error_us=5.0,
    hermite_error_us=0.1,
    step_s=1e-3,
    active_share=0.3,
    least_current=0.1,
    largest_current=1.0,
    fastest_change=300.0,
    events_per_s=1e6,
    draw_s=1e-3,
    draw_with_rate_s=2e-3,
    motion_px_s=20.0,
)
SENSOR = dataclasses.replace(
    PRESETS["davis346"],
    source_follower_hz=286.0,
    parasitic_hz_at_reference=0.05,
    noise=NoiseParameters(rms=0.05),
    jitter=JitterParameters(latency_us=10.0, deviation_us=2.0),
    defects=DefectParameters(hot_share=1e-3),
    radiation=RadiationParameters(hits_per_cm2_s=4.0),
)
ALL = {
    "low-pass",
    "source follower",
    "leak",
    "parasitic",
    "mismatch",
    "refractory period",
    "noise",
    "jitter",
    "hot pixels",
    "radiation",
}


def decisions(eps_us, wrong_share=0.01, sensor=SENSOR, scene=SCENE, duration_s=10.0):
    return {d.effect: d for d in decide(sensor, scene, Tolerance(eps_us, wrong_share, duration_s))}


def test_every_effect_that_is_on_has_a_decision():
    assert set(decisions(10.0)) == ALL


def test_effects_that_are_off_have_none():
    bare = dataclasses.replace(
        PRESETS["davis346"], corner_hz_at_reference=math.inf, leak_hz=0.0, mismatch=0.0, refractory_us=0.0
    )
    assert decisions(10.0, sensor=bare) == {}


def test_nothing_is_dropped_without_tolerance_and_everything_with_much():
    assert all(d.kept for d in decisions(0.0, 0.0).values())
    assert not any(d.kept for d in decisions(1e12, 1.0).values())


@pytest.mark.parametrize("effect", sorted(ALL))
def test_a_cost_is_compared_with_the_tolerance(effect):
    cost = decisions(1.0)[effect]
    eps_us = cost.cost_us if cost.cost_us is not None else 1.0
    share = cost.cost_share if cost.cost_share is not None else 0.5
    assert decisions(eps_us * 0.99, share * 0.99)[effect].kept
    assert not decisions(eps_us * 1.01, min(share * 1.01, 1e9))[effect].kept


def test_dropping_takes_an_effect_out_of_the_sensor():
    loose = list(decisions(1e12, 1.0).values())
    bare = without(SENSOR, loose)
    assert decisions(1.0, sensor=bare) == {}
    assert (bare.width, bare.threshold_on, bare.readout) == (SENSOR.width, SENSOR.threshold_on, SENSOR.readout)


def test_kept_effects_stay_as_they_are():
    assert without(SENSOR, list(decisions(0.0, 0.0).values())) == SENSOR


def test_the_figures_of_the_table():
    found = decisions(10.0)
    assert found["low-pass"].cost_us == pytest.approx(1e6 / (2 * math.pi * 300), rel=1e-6)
    assert found["source follower"].cost_us == pytest.approx(556.5, rel=1e-3)
    # leak 0.1 Hz, threshold 0.2725, 10 s, contrast rate 20: the drift is at most one event's interval
    assert found["leak"].cost_us == pytest.approx(0.1 * 0.2725 * 10 / 20 * 1e6, rel=1e-6)
    assert found["leak"].cost_share == pytest.approx(0.1 * 0.2725 / 20, rel=1e-6)
    assert found["refractory period"].cost_share == pytest.approx(3.4e-6 * 20 / 0.2725, rel=1e-6)
    assert found["jitter"].cost_us == 14.0
    assert found["hot pixels"].cost_share == pytest.approx(346 * 260 * 1e-3 * 20 / 1e6, rel=1e-6)


def test_in_a_still_scene_what_makes_events_is_kept():
    still = dataclasses.replace(
        SCENE, contrast_rate=0.0, events_per_s=0.0, least_current=math.nan, largest_current=math.nan
    )
    kept = {name for name, d in decisions(100.0, scene=still).items() if d.kept}
    assert {"leak", "noise", "hot pixels", "radiation"} <= kept
