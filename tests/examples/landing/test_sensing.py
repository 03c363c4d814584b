"""The vehicle's own sensors, its navigation and the judgement, against closed forms: `pytest test_sensing.py`."""

import dataclasses
import math
import struct

import numpy as np
import pytest
from divergence import Motion
from frames import PUSH, RANGE, STAR, nearest_number, pack_words, unpack_words
from navigation import Filter, Known, of_events, of_range, of_star
from pilot import Pilot
from report import judgement
from scipy.stats import chi2
from sensors import PERIOD_S, Inertial, SensorErrors, Sensors, turn_of, vector_of
from spacecraft import Mission, Spacecraft, TouchDown, WithoutCamera
from vehicle import GRAVITY_M_S2, Lander, State, advance, product

ROLLING = State(np.array([3.0, 4.0, 100.0]), np.array([0.5, 0.0, -8.0]), thrust_n=1620.0)


def sensors(errors=None, seed=5):
    """Return sensors over level ground."""
    return Sensors(errors or SensorErrors(), Lander(), seed, lambda x, y: 0.0)


def averages(errors, seed, seconds, samples=6_000):
    """Return the mean rates of a gyroscope at rest over stretches of a length, (n, 3)."""
    unit, still = sensors(SensorErrors(gyroscope=errors), seed), State(np.zeros(3), np.zeros(3))
    turns = np.array([unit.turn_rad(k, still, still) for k in range(samples)])
    length = round(seconds / PERIOD_S)
    return turns[: samples // length * length].reshape(-1, length, 3).mean(axis=1) / PERIOD_S


@pytest.mark.parametrize(("seconds", "drift"), [(0.1, 0.0), (1.0, 0.0), (0.4, 0.01), (2.0, 0.01)])
def test_the_allan_variance_is_that_of_white_noise_and_drift(seconds, drift):
    """N^2 / t, and for a Gauss-Markov drift of 1 s: 2 s^2 (T/t) (1 - T/2t (3 - 4 exp(-t/T) + exp(-2t/T))).

    The bound is four standard deviations of the estimate; a constant bias has no influence.
    """
    errors, x = Inertial(white=1e-3, bias=0.05, drift=drift, correlation_s=1.0), seconds
    means = averages(errors, 3, seconds)
    found = (np.diff(means, axis=0) ** 2).mean() / 2
    markov = 2 * drift**2 / x * (1 - (3 - 4 * math.exp(-x) + math.exp(-2 * x)) / (2 * x))
    assert found == pytest.approx(1e-6 / x + markov, rel=4 * math.sqrt(3 / means.size))


def test_a_sample_does_not_depend_on_the_step_of_the_dynamics():
    """A period in one call or in two, to a hundredth of the frame's unit; push and turn are the true ones."""
    command, unit = np.array([0.1, -0.05, 2.0]), sensors()
    whole = advance(Lander(), ROLLING, command, PERIOD_S)
    halves = advance(Lander(), advance(Lander(), ROLLING, command, PERIOD_S / 2), command, PERIOD_S / 2)
    assert unit.push_m_s(7, ROLLING, whole) == pytest.approx(unit.push_m_s(7, ROLLING, halves), abs=1e-7)
    exact = sensors(SensorErrors(gyroscope=Inertial(0, 0, 0), accelerometer=Inertial(0, 0, 0)))
    mean_n = (ROLLING.thrust_n + whole.thrust_n) / 2
    assert exact.push_m_s(7, ROLLING, whole) == pytest.approx([0, 0, mean_n / 1000 * PERIOD_S], rel=0.01, abs=1e-6)
    turn = np.array([0.01, -0.02, 0.003])
    turned = dataclasses.replace(ROLLING, attitude=turn_of(turn))
    assert exact.turn_rad(7, ROLLING, turned) == pytest.approx(turn, abs=1e-12)
    assert vector_of(-turn_of(turn)) == pytest.approx(turn, abs=1e-12)


def test_rates_and_delays_are_exact():
    """Every sample of the IMU one period later, each tenth attitude ten later, each fifth range two later."""
    unit, sent = sensors(), []
    for number in range(1, 101):
        frames = unit.frames(number, ROLLING, ROLLING)
        sent += [(number, identifier, int.from_bytes(data[-2:], "little")) for identifier, data in frames]
        sent[-3:] = [(at, one, k if one != RANGE else 0) for at, one, k in sent[-3:]]
    assert [(at, k) for at, one, k in sent if one == PUSH] == [(k + 1, k) for k in range(1, 100)]
    assert [(at, k) for at, one, k in sent if one == STAR] == [(k + 10, k) for k in range(10, 91, 10)]
    assert [at for at, one, _ in sent if one == RANGE] == [k + 2 for k in range(5, 99, 5)]
    assert [one for at, one, _ in sent if at == 100][-1] == PUSH  # the last of its time


def test_the_altimeter_looks_along_the_body():
    """Over ground that rises to the east, tilted: the beam meets the plane; none beyond its longest range."""
    exact = SensorErrors(range_white_m=0.0, range_white_scale=0.0, range_scale=0.0)
    unit = Sensors(exact, Lander(), 1, lambda x, y: 0.1 * x)
    tilted = dataclasses.replace(ROLLING, attitude=turn_of(np.array([0.0, 0.1, 0.0])))
    east, down = -math.sin(0.1), math.cos(0.1)
    assert unit.range_m(0, tilted) == pytest.approx((100 - 0.3) / (down + 0.1 * east), abs=0.01)
    assert unit.range_m(0, dataclasses.replace(ROLLING, position_m=np.array([0.0, 0.0, 4000.0]))) == 0.0


def test_frames_of_sensors_carry_what_was_put_in():
    """Rounded and clipped, and numbers beyond 65 535."""
    words, number = unpack_words(pack_words(np.array([12345.6, -1.0, 9e6]), 70_001))
    assert words.tolist() == [12346, -1, 32767]
    assert nearest_number(number, 70_000) == 70_001
    with pytest.raises(struct.error, match="8 bytes"):
        unpack_words(b"ab")


KNOWN = Known((0.0, 0.0, 100.0), (0.0, 0.0, -8.0), 5.0, 5.0, 0.7)


def steady(seed, seconds=8.0):
    """Return a filter on a vertical braking of 0.4 m/s2 from a start drawn by its own covariance, and its errors."""
    errors, draw, rest = SensorErrors(), np.random.default_rng(seed), np.array([1.0, 0.0, 0.0, 0.0])
    unit, braking = sensors(errors, seed), 0.4
    found = Filter(KNOWN, errors)
    first = draw.multivariate_normal(np.zeros(15), found.now.covariance)
    place, speed = np.array(KNOWN.position_m) + first[:3], np.array(KNOWN.velocity_m_s) + first[3:6]
    bias, attitude = first[9:12], product(rest, turn_of(first[6:9]))

    def at(t_s):
        up = np.array([0.0, 0.0, braking])
        return State(place + speed * t_s + up * t_s**2 / 2, speed + up * t_s, attitude)

    for k in range(1, round(seconds / PERIOD_S) + 1):
        before, after = at((k - 1) * PERIOD_S), at(k * PERIOD_S)
        push = unit.push_m_s(k, before, after) + (bias - unit._pushes._bias) * PERIOD_S
        turn = unit.turn_rad(k, before, after) + (first[12:] - unit._turns._bias) * PERIOD_S
        found.sample(k, turn, push)
        if k % 20 == 0:
            sigma = np.full(3, 0.002)
            middle = at((k - 10) * PERIOD_S)
            seen = middle.velocity_m_s * (1, -1, -1) / middle.position_m[2] + sigma * draw.normal(size=3)
            found.measure(k - 10, of_events(seen, sigma**2))
            found.measure(k, of_star(unit.attitude(k, after), errors))
    end, now = at(seconds), found.now
    wrong = np.concatenate([end.position_m - now.position_m, end.velocity_m_s - now.velocity_m_s])
    return found, wrong


def test_the_filter_is_as_good_as_it_claims():
    """Errors of place and velocity in units of the covariance, over 8 flights: chi-squared of 48, 0.1 % each side."""
    total = 0.0
    for seed in range(8):
        found, wrong = steady(seed)
        total += float(wrong @ np.linalg.solve(found.now.covariance[:6, :6], wrong))
    assert chi2.ppf(0.001, 8 * 6) < total < chi2.ppf(0.999, 8 * 6)


def test_events_and_braking_give_the_scale():
    """Height and speed are known far better than at the start, without an altimeter."""
    sigma = np.sqrt(np.diag(steady(1)[0].now.covariance))
    assert sigma[2] < 2.5
    assert (sigma[3:6] < (0.2, 0.2, 0.35)).all()


def test_a_late_measurement_counts_as_one_in_time():
    """In any order, to the last bit; one that is older than what is stored is refused."""
    one = of_range(99.0, SensorErrors(), 0.5), of_events(np.array([0.0, 0.0, 0.08]), np.full(3, 1e-6))
    still, push = np.zeros(3), np.array([0.0, 0.0, GRAVITY_M_S2 * PERIOD_S])
    in_time, late = Filter(KNOWN, SensorErrors()), Filter(KNOWN, SensorErrors())
    for k in range(1, 60):
        in_time.sample(k, still, push)
        late.sample(k, still, push)
        for at, measurement in zip((20, 35), one, strict=True):
            if k == at:
                in_time.measure(k, measurement)
    assert late.measure(35, one[1])
    assert late.measure(20, one[0])
    assert np.array_equal(in_time.now.position_m, late.now.position_m)
    assert np.array_equal(in_time.now.covariance, late.now.covariance)
    assert not late.measure(-1, one[0])


def landed(navigation, seed):
    """Return the end of a flight from 20 m, with motions of 1 % where it uses events."""
    mission, draw = Mission.drawn(20.0, seed), np.random.default_rng(seed)
    mission = dataclasses.replace(mission, known=dataclasses.replace(mission.known, height_sigma_m=2.0))
    known = np.array(mission.known.position_m) + (0.0, 0.0, 2.0)
    mission = dataclasses.replace(mission, known=dataclasses.replace(mission.known, position_m=tuple(known)))
    pilot, spacecraft = Pilot(mission.known, navigation), []

    class Seeing(WithoutCamera):
        """Links whose pilot gets the motion that a camera would have measured."""

        def answer(self, t_s, turn, limit_s):
            state = spacecraft[0].state
            east, north, up = state.velocity_m_s / state.position_m[2] * (1 + 0.01 * draw.normal(size=3))
            pilot.take_motion(Motion(east, -north, -up, 2.0, t_s - PERIOD_S, 9), t_s, 0.2)
            return super().answer(t_s, turn, limit_s)

    unit = Sensors(SensorErrors(), mission.lander, seed, lambda x, y: 0.0)
    links = Seeing(pilot)
    spacecraft.append(Spacecraft(mission.lander, mission.state, links, sensors=unit))
    return spacecraft[0].land(lambda x, y: 0.0, lambda t_s, state: None)


def test_events_land_where_dead_reckoning_crashes():
    """The same start, with a height that is 2 m too high: the whole loop of sensors, frames, filter and law."""
    good, blind = landed("events", 2), landed("blind", 2)
    assert good.vertical_m_s < 0.8
    assert good.horizontal_m_s < 0.2
    assert max(blind.vertical_m_s / 1.0, blind.horizontal_m_s / 0.5) > 1.2


@pytest.mark.parametrize(
    ("velocity", "turn", "place", "beyond"),
    [
        ((0.3, 0.3, -0.9), (0.05, 0.05, 1.0), (17.0, 17.0), []),
        ((0.0, 0.0, -1.1), (0.0, 0.0, 0.0), (0.0, 0.0), ["vertical_m_s"]),
        ((0.4, 0.4, -0.5), (0.0, 0.0, 0.0), (0.0, 0.0), ["horizontal_m_s"]),
        ((0.0, 0.0, -0.5), (0.07, 0.07, 0.0), (0.0, 0.0), ["tilt_deg"]),
        ((0.0, 0.0, math.nan), (0.0, 0.0, 0.0), (18.0, 18.0), ["vertical_m_s", "place_m"]),
    ],
)
def test_each_bound_is_judged(velocity, turn, place, beyond):
    """One at a time; a turn about the vertical is no tilt."""
    state = State(np.array([*place, 2.0]), np.array(velocity), turn_of(np.array(turn)))
    found = judgement(TouchDown(30.0, state, touched=True, fuel_kg=5.0), lambda x, y: 0.0)
    assert found["beyond"] == beyond
    assert found["soft"] == (not beyond)
