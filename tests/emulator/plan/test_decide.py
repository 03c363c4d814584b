"""Effects kept or dropped by their bounds."""

import dataclasses
import functools
import math

import pytest

from emulator.optics.lens import LensParameters
from emulator.plan import costs
from emulator.plan.costs import EFFECTS, SHAPES_NOISE, lens_costs
from emulator.plan.plan import Tolerance, decide, without
from emulator.plan.scene_probe import Probe
from emulator.sensor.noise.law import still_hz
from emulator.sensor.parameters import (
    ComparatorParameters,
    DefectParameters,
    ImagerParameters,
    JitterParameters,
    NoiseParameters,
    RadiationParameters,
    ResetParameters,
    TemperatureParameters,
)
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
    motion_px_s=20.0,
)
SENSOR = dataclasses.replace(
    PRESETS["davis346"],
    leak_hz=0.1,
    source_follower_hz=286.0,
    highpass_hz=1.0,
    parasitic_hz_at_reference=0.05,
    temperature=TemperatureParameters(celsius=30.0),
    noise=NoiseParameters(rms=0.05),
    jitter=JitterParameters(latency_us=10.0, deviation_us=2.0, leak_share=0.2),
    defects=DefectParameters(hot_share=1e-3, dead_share=1e-3),
    imager=ImagerParameters(
        system_efficiency=0.8,
        quantum_efficiency=0.9,
        prnu=0.01,
        dcnu=0.3,
        photon_shot_noise=True,
        dark_shot_noise=True,
        electrons_per_s_at_reference=2e4,
    ),
    radiation=RadiationParameters(hits_per_cm2_s=4.0, dose_krad=1.0),
    comparator=ComparatorParameters(on_us=0.03, off_us=53.0),
    reset=ResetParameters(offset=0.01, noise=0.002, at_acknowledge=True),
)
WITHOUT_NOISE = dataclasses.replace(SENSOR, noise=NoiseParameters())
ALL = {
    "low-pass",
    "bandwidth following the light",
    "source follower",
    "high-pass",
    "leak",
    "leak spread",
    "leak jitter",
    "parasitic",
    "mismatch",
    "refractory period",
    "noise",
    "jitter",
    "comparator",
    "reset offset",
    "reset noise",
    "acknowledge",
    "temperature",
    "system efficiency",
    "quantum efficiency",
    "PRNU",
    "DCNU",
    "photon shot noise",
    "dark shot noise",
    "hot pixels",
    "dead pixels",
    "radiation",
    "dose",
}
ALWAYS = {"dark current"}
NOT_ASKED = {"large signals"}


STILL_HZ = functools.cache(still_hz)  # solved once: no tolerance changes it


@pytest.fixture(autouse=True)
def solved_once(monkeypatch):
    monkeypatch.setattr(costs, "still_hz", STILL_HZ)


def decisions(eps_us, wrong_share=0.01, sensor=SENSOR, scene=SCENE, duration_s=10.0):
    return {d.effect: d for d in decide(sensor, scene, Tolerance(eps_us, wrong_share, duration_s))}


def test_every_effect_that_is_on_has_a_decision():
    assert set(decisions(10.0)) == ALL | ALWAYS | NOT_ASKED
    assert set(EFFECTS) == ALL | ALWAYS | NOT_ASKED | {"veiling glare"}


def test_effects_that_are_off_have_none():
    bare = dataclasses.replace(
        PRESETS["ideal"], threshold_on=0.2725, threshold_off=0.2725, corner_hz_at_reference=math.inf
    )
    assert set(decisions(10.0, sensor=bare)) == ALWAYS


def test_nothing_is_dropped_without_tolerance_and_everything_with_much():
    assert {name for name, d in decisions(0.0, 0.0).items() if not d.kept} == NOT_ASKED
    assert {name for name, d in decisions(1e12, 1.0).items() if d.kept} == ALWAYS


@pytest.mark.parametrize("effect", sorted(ALL))
def test_a_cost_is_compared_with_the_tolerance(effect):
    sensor = WITHOUT_NOISE if effect in SHAPES_NOISE else SENSOR  # what noise depends on is kept with it
    cost = decisions(1.0, sensor=sensor)[effect]
    eps_us = cost.cost_us if cost.cost_us is not None else 1.0
    share = cost.cost_share if cost.cost_share is not None else 0.5
    assert decisions(eps_us * 0.99, share * 0.99, sensor)[effect].kept
    assert not decisions(eps_us * 1.01, min(share * 1.01, 1e9), sensor)[effect].kept


def test_what_the_rate_of_noise_depends_on_is_kept_with_it():
    noisy = dataclasses.replace(SENSOR, noise=NoiseParameters(rms=0.08))
    found = decisions(5000.0, 0.04, noisy, duration_s=1e-3)  # noise costs 4.3 % of the events
    quiet = decisions(5000.0, 0.04, WITHOUT_NOISE, duration_s=1e-3)
    dropped = {name for name, d in found.items() if not d.kept}
    assert found["noise"].kept
    assert {"source follower", "jitter", "leak spread"} <= dropped
    assert not dropped & SHAPES_NOISE
    assert {name for name in SHAPES_NOISE if quiet[name].kept} == {"high-pass"}
    planned = without(noisy, list(found.values()))
    assert still_hz(planned, 300.0) == pytest.approx(still_hz(noisy, 300.0), rel=1e-12)


@pytest.mark.parametrize("effect", sorted(ALL))
def test_an_effect_goes_alone(effect):
    bare = without(SENSOR, [dataclasses.replace(decisions(1.0)[effect], kept=False)])
    gone = ALL - set(decisions(1.0, sensor=bare))
    with_it = {"low-pass": {"bandwidth following the light"}, "leak": {"leak spread", "leak jitter"}}
    assert gone == {effect} | with_it.get(effect, set())
    assert bare != SENSOR


def test_a_photoreceptor_of_large_signals_is_dropped_where_it_hardly_matters():
    sensor = dataclasses.replace(SENSOR, photoreceptor="circuit")
    # the second pole at 3 kHz, and its slew over light of 10:1
    bound_us = 1e6 * (1 + math.log(10)) / (2 * math.pi * 3000)
    assert decisions(0.99 * bound_us, sensor=sensor)["large signals"].kept
    dropped = decisions(1.01 * bound_us, sensor=sensor)["large signals"]
    assert without(sensor, [dropped]).photoreceptor == "large_signal"
    assert not decisions(0.0)["large signals"].kept


def test_the_figures_of_the_table():
    found = decisions(10.0)
    assert found["low-pass"].cost_us == pytest.approx(1e6 / (2 * math.pi * 300), rel=1e-6)
    assert found["source follower"].cost_us == pytest.approx(556.5, rel=1e-3)
    # light of 10:1 at a contrast rate of 20: a run of ln(10)/20 s
    z = 2 * math.pi * math.log(10) / 20
    assert found["high-pass"].cost_us is None
    assert found["high-pass"].cost_share == pytest.approx(1 - (1 - math.exp(-z)) / z, rel=1e-6)
    # leak 0.1 Hz, threshold 0.2725, 10 s, contrast rate 20: the drift is at most one event's interval
    assert found["leak"].cost_us == pytest.approx(0.1 * 0.2725 * 10 / 20 * 1e6, rel=1e-6)
    assert found["leak"].cost_share == pytest.approx(0.1 * 0.2725 / 20, rel=1e-6)
    assert found["refractory period"].cost_share == pytest.approx(3.4e-6 * 20 / 0.2725, rel=1e-6)
    assert found["jitter"].cost_us == 14.0
    tau_us = 1e6 / (2 * math.pi * 300)
    assert found["bandwidth following the light"].cost_us == pytest.approx(tau_us * 0.9, rel=1e-6)
    assert found["leak jitter"].cost_us == pytest.approx(0.2 * found["leak"].cost_us, rel=1e-6)
    assert found["leak spread"].cost_us == pytest.approx(0.3 * found["leak"].cost_us, rel=1e-6)
    assert found["dark current"].cost_share == pytest.approx(0.01)
    warm = 2 ** (10 / 9) - 1, 2 ** (10 / 8) - 1
    assert found["temperature"].cost_us == pytest.approx(0.2725 / 20 * 1e6, rel=1e-6)  # all of an interval
    assert found["temperature"].cost_share == pytest.approx(warm[0] * found["leak"].cost_share + warm[1] * 0.01)
    assert found["system efficiency"].cost_us == pytest.approx(tau_us * 0.25 * 0.99, rel=1e-6)
    assert found["quantum efficiency"].cost_share == pytest.approx((1 / 0.9 - 1) * 0.01, rel=1e-6)
    assert found["PRNU"].cost_us == pytest.approx(tau_us * 0.02 * 0.99, rel=1e-6)
    assert found["DCNU"].cost_us == pytest.approx(tau_us * 0.6 * 0.01, rel=1e-6)
    assert found["DCNU"].cost_share == pytest.approx(0.6 * 0.01, rel=1e-6)
    electrons = 2e4 * 8192e-6
    assert found["photon shot noise"].cost_us == pytest.approx(math.sqrt(0.099 / electrons) / 0.1 / 20 * 1e6, rel=1e-6)
    assert found["dark shot noise"].cost_us == pytest.approx(math.sqrt(0.001 / electrons) / 0.1 / 20 * 1e6, rel=1e-6)
    assert found["dead pixels"].cost_share == 1e-3
    assert found["dose"].cost_share == pytest.approx(346 * 260 * 1e-3 * 20 / 1e6, rel=1e-3)
    area_cm2 = 346 * 260 * (18.5e-4) ** 2
    assert found["radiation"].cost_share == pytest.approx(4 * area_cm2 * (1 + 20 / 18.5) * 1.3 / 1e6, rel=1e-6)
    assert found["hot pixels"].cost_share == pytest.approx(346 * 260 * 1e-3 * 20 / 1e6, rel=1e-6)


def test_in_a_still_scene_what_makes_events_is_kept():
    still = dataclasses.replace(
        SCENE, contrast_rate=0.0, events_per_s=0.0, least_current=math.nan, largest_current=math.nan
    )
    kept = {name for name, d in decisions(100.0, scene=still).items() if d.kept}
    assert {"leak", "noise", "hot pixels", "radiation"} <= kept


def test_veiling_glare_costs_its_share_of_the_darkest_light_and_is_never_left_out():
    scene = dataclasses.replace(SCENE, mean_current=0.5)
    (cost,) = lens_costs(LensParameters(veiling_glare=0.02), SENSOR, scene)
    assert cost.cost_share == pytest.approx(0.02 * 0.5 / 0.1)
    assert cost.kept
    assert not cost.choice
    assert lens_costs(LensParameters(), SENSOR, scene) == []
