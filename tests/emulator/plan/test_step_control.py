"""Steps under error control, on light whose best step is known."""

import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.plan.step_control import ControlledSteps, Limits, RefinementModel, error_us, sample, weighted_quantile

DARK = 1e-3
PHASES = np.linspace(0, 2 * np.pi, 900, endpoint=False).reshape(30, 30)
OMEGA = 2 * np.pi * 20


def sine(t_ns, with_rate=True):
    """A grating in log light, ln u = 0.85 sin(w t + phase), less the dark floor."""
    angle = OMEGA * t_ns * 1e-9 + PHASES
    current = np.exp(0.85 * np.sin(angle))
    rate = (0.85 * OMEGA * np.cos(angle) * current).astype(np.float32)
    return LightFrame(t_ns, (current - DARK).astype(np.float32), rate if with_rate else None)


def settled(tolerance_us, with_rate, first_ns=1_000_000, limits=None):
    steps = ControlledSteps(limits or Limits(tolerance_us, wrong_share=1.0), DARK, first_ns)
    t_ns = 0
    for _ in range(40):
        steps.observe(sine(t_ns, with_rate))
        t_ns += steps.step_ns
    return steps.step_ns * 1e-6


def line_error_us(dt_s):
    """The straight line's true timestamp error, 95th percentile over events, by brute force."""
    u = np.linspace(0, 1, 401)
    errors, weights = [], []
    for phase in PHASES.reshape(-1)[::10]:
        exact = 0.85 * np.sin(OMEGA * dt_s * u + phase)
        slope = np.gradient(exact, u * dt_s)
        line = exact[0] + (exact[-1] - exact[0]) * u
        errors.extend(np.abs(line - exact) / np.maximum(np.abs(slope), 1e-9) * 1e6)
        weights.extend(np.abs(slope))
    return weighted_quantile(np.array(errors), np.array(weights), 0.95)


@pytest.mark.parametrize("tolerance_us", [3.0, 30.0])
def test_a_line_gets_the_error_that_was_asked_for(tolerance_us):
    assert tolerance_us / 3 < line_error_us(settled(tolerance_us, with_rate=False) * 1e-3) < tolerance_us * 2


@pytest.mark.parametrize(("with_rate", "order"), [(False, 2), (True, 4)])
def test_a_tolerance_n_times_wider_allows_steps_longer_by_its_root(with_rate, order):
    ratio = settled(16.0, with_rate) / settled(1.0, with_rate)
    assert ratio == pytest.approx(16 ** (1 / order), rel=0.15)


def test_steps_stay_within_their_limits():
    assert settled(1e9, True, limits=Limits(1e9, wrong_share=1.0, longest_ns=3_000_000)) == 3.0
    assert settled(1e-9, False, limits=Limits(1e-9, shortest_ns=70_000)) == pytest.approx(0.07)


def test_few_events_are_wrong_where_light_turns_though_times_would_allow_more():
    loose, strict = (settled(1e3, True, limits=Limits(1e3, wrong_share=share)) for share in (1.0, 1e-4))
    assert strict < 0.7 * loose
    assert settled(1e3, True, limits=Limits(1e3, wrong_share=16e-4)) == pytest.approx(2 * strict, rel=0.2)


def test_halves_allow_longer_steps_until_they_cost_a_picture():
    limits, lengths = Limits(10.0, wrong_share=3e-5), []
    for refinement in (None, RefinementModel(0.2)):
        steps, t_ns = ControlledSteps(limits, DARK, 1_000_000, refinement), 0
        for _ in range(60):
            steps.observe(sine(t_ns))
            t_ns += steps.step_ns
        lengths.append(steps.step_ns)
    assert 1.5 < lengths[1] / lengths[0] < 4


def test_one_glint_does_not_set_the_pace():
    def observe(glint):
        steps, t_ns, lengths = ControlledSteps(Limits(10.0, wrong_share=1.0), DARK, 1_000_000), 0, []
        while t_ns < 1_000_000_000:
            frame = sine(t_ns)
            if glint:  # one of 900 pixels flashes 100:1, ten times a second
                frame.light[3, 3] = 50.0 if t_ns // 50_000_000 % 2 else 0.5
                frame.rate[3, 3] = 0.0
            steps.observe(frame)
            t_ns += steps.step_ns
            lengths.append(steps.step_ns)
        return np.mean(lengths)

    assert observe(True) > 0.8 * observe(False)


def test_a_still_picture_takes_the_longest_steps():
    steps = ControlledSteps(Limits(1.0), DARK, 100_000)
    light, t_ns = np.full((8, 8), 0.3, np.float32), 0
    for _ in range(20):
        steps.observe(LightFrame(t_ns, light, np.zeros_like(light)))
        t_ns += steps.step_ns
    assert steps.step_ns == 100_000_000


def test_light_that_is_not_a_number_is_left_out():
    first, later = sine(0), sine(1_000_000)
    first.light[0, 0] = later.light[0, 0] = np.nan
    frames = first, later, dataclasses.replace(first, t_ns=2_000_000)
    a, b, c = (sample(frame, DARK) for frame in frames)
    error, weight = error_us(a, b, c)
    assert np.isfinite(error).all()
    assert weight[0] == 0
