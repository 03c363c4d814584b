"""Orbits, spins, tumbling, looking and landing, against integrated equations and closed forms."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from emulator.geometry.attitude import matrix_of, quaternion_of
from emulator.geometry.camera import Cycle
from emulator.trajectory.laws import LANDING, Descent, Gate, Orbit, OrbitPath, eccentric_anomaly
from emulator.trajectory.mounting import Looking, Spinning
from emulator.trajectory.pose import Fixed, Timescale, TrajectoryError, instants_over, measured_bounds

S = 1_000_000_000
EROS = OrbitPath(4.4628e5, 50_000.0, 0.4, 35.0, 20.0, 70.0, 15.0)


def test_an_orbit_is_what_gravity_does():
    orbit = Orbit(EROS)
    h = 1000  # us
    start = orbit.pose(0).position_m
    velocity = (orbit.pose(h * 1000).position_m - orbit.pose(-h * 1000).position_m) / (2e-6 * h)

    def pull(_, state):
        return np.concatenate([state[3:], -EROS.gm_m3_s2 * state[:3] / np.linalg.norm(state[:3]) ** 3])

    after_s = 0.7 * EROS.period_s
    flown = solve_ivp(pull, (0, after_s), np.concatenate([start, velocity]), rtol=1e-11, atol=1e-6).y[:3, -1]
    np.testing.assert_allclose(orbit.pose(round(after_s * S)).position_m, flown, atol=0.05)


@given(st.floats(-10, 10), st.floats(0, 0.999))
def test_kepler_s_equation_is_solved(mean, eccentricity):
    e = eccentric_anomaly(mean, eccentricity)
    assert math.remainder(e - eccentricity * math.sin(e) - mean, 2 * math.pi) == pytest.approx(0, abs=1e-13)


def test_an_orbit_refuses_what_does_not_return():
    with pytest.raises(ValueError, match="eccentricity is 1"):
        OrbitPath(1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="gm_m3_s2 must be above 0, got -1"):
        OrbitPath(-1.0, 1.0)


def test_tumbling_is_what_a_free_symmetric_top_does():
    """Euler's equations for moments (2, 2, 1), momentum along the world's z, tilt 0.5."""
    tilt, inertia, momentum = 0.5, np.array([2.0, 2.0, 1.0]), 0.6
    precession = momentum / inertia[0]
    spin = momentum * math.cos(tilt) * (1 / inertia[2] - 1 / inertia[0])
    tumbling = Spinning((0, 0, 0), (0, 0, 1), Cycle(spin / (2 * math.pi)), tilt, Cycle(precession / (2 * math.pi)))

    def euler(_, state):
        q, rate = state[:4], state[4:]
        w, v = q[0], q[1:]
        turning = np.concatenate([[-v @ rate], w * rate + np.cross(v, rate)]) / 2
        return np.concatenate([turning, np.cross(inertia * rate, rate) / inertia])

    start = tumbling.pose(0).world_from_body
    rate = start.T @ np.array([0, 0, momentum]) / inertia
    flown = solve_ivp(euler, (0, 20), np.concatenate([quaternion_of(start), rate]), rtol=1e-10, atol=1e-12).y[:4, -1]
    np.testing.assert_allclose(tumbling.pose(20 * S).world_from_body, matrix_of(flown), atol=1e-6)


def test_a_tilt_of_minus_a_quarter_lays_the_axis_along_y():
    lying = Spinning((0, 0, 0), (0, 0, 1), Cycle(0), -math.pi / 2, Cycle(0)).pose(0).world_from_body
    np.testing.assert_allclose(lying @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(lying @ [0, 1, 0], [0, 0, -1], atol=1e-12)


def test_a_spin_s_bound_is_its_rate():
    spinning = Spinning((1, 2, 3), (0, 1, 0), Cycle(0.1), 0.3, Cycle(-0.2))
    _, turn = measured_bounds(spinning.pose, [k * 10_000_000 for k in range(200)])
    assert turn / 1.25 <= spinning.bounds.turn_rad_s * (1 + 1e-6)
    assert spinning.bounds.turn_rad_s == pytest.approx(2 * math.pi * 0.3)


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_a_quaternion_comes_back_from_its_matrix(q):
    oracle = Rotation.from_quat(q, scalar_first=True)
    np.testing.assert_allclose(matrix_of(quaternion_of(oracle.as_matrix())), oracle.as_matrix(), atol=1e-12)


def test_a_looking_camera_sees_its_target_ahead_and_up_above():
    camera = Looking(Orbit(EROS), (100.0, 0.0, -50.0), (0.0, 0.0, 1.0), [0, S])
    for t_ns in (0, 3000 * S, 30_000 * S):
        pose = camera.pose(t_ns)
        ahead = pose.world_from_body.T @ (np.array([100.0, 0, -50]) - pose.position_m)
        np.testing.assert_allclose(ahead[:2], 0, atol=1e-6)
        assert ahead[2] > 0
        up = pose.world_from_body.T @ [0, 0, 1]
        assert up[0] == pytest.approx(0, abs=1e-12)
        assert up[1] < 0


def test_looking_straight_up_is_defined_and_looking_at_oneself_refused():
    above = Looking(Fixed(), (0, 0, 5), (0, 0, 1), [0, S])
    np.testing.assert_allclose(above.pose(0).world_from_body @ [0, 0, 1], [0, 0, 1], atol=1e-12)
    with pytest.raises(TrajectoryError, match="the very point"):
        Looking(Fixed(), (0, 0, 0), (0, 0, 1), [0, S])


def test_a_landing_passes_its_gates_and_ends_on_its_site():
    landing = Descent(LANDING, heading_deg=90.0, site_m=(10.0, 20.0, 5.0))
    for gate in LANDING:
        pose = landing.pose(round(gate.t_s * S))
        assert pose.position_m[2] - 5.0 == pytest.approx(gate.height_m)
        boresight = pose.world_from_body @ [0, 0, 1]
        assert math.degrees(math.asin(min(1.0, -boresight[2]))) == pytest.approx(gate.depression_deg, abs=1e-5)
    np.testing.assert_allclose(landing.pose(10**13).position_m, [10, 20, 9], atol=1e-9)
    # between gates the mean of their speeds: 30 s of 72.5, 30 s of 26.5 and 25 s of 4 m/s
    assert landing.pose(0).position_m[0] == pytest.approx(10 - 3070)
    up = landing.pose(0).world_from_body.T @ [0, 0, 1]
    assert up[1] < 0


def test_a_landing_has_the_gates_speeds():
    landing = Descent(LANDING)
    for gate in LANDING[1:-1]:
        around = [landing.pose(round((gate.t_s + d) * S)).position_m for d in (-1e-3, 1e-3)]
        np.testing.assert_allclose((around[1] - around[0]) / 2e-3, [0, gate.forward_m_s, -gate.down_m_s], atol=0.05)


def test_a_boresight_held_straight_down_stays_there():
    landing = Descent(LANDING)
    boresights = [landing.pose(t * S).world_from_body @ [0, 0, 1] for t in range(85, 166, 5)]
    np.testing.assert_allclose(boresights, [[0, 0, -1]] * len(boresights), atol=1e-9)


def test_a_landing_through_the_ground_is_refused():
    with pytest.raises(TrajectoryError, match="goes through the ground at"):
        Descent([Gate(0, 100, 0, 50), Gate(20, 90, 0, -50)])


@pytest.mark.parametrize("bad", [{"height_m": 0.0}, {"depression_deg": 91.0}, {"down_m_s": math.nan}])
def test_a_gate_refuses_nonsense(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Gate(**{"t_s": 0.0, "height_m": 1.0, **bad})


def test_a_timescale_is_exact():
    fast = Timescale(0.1)
    assert fast.scene_ns(10**18 + 17) == 10**17 + 1
    assert fast.factor == 0.1


def test_a_path_s_span_has_all_its_poses():
    circle = Orbit(OrbitPath(gm_m3_s2=4e5, semi_major_axis_m=1e4))
    first_ns, last_ns = circle.span_ns
    np.testing.assert_allclose(circle.pose(last_ns).position_m, circle.pose(first_ns).position_m, atol=1e-3)
    assert Looking(circle, (0, 0, 0), (0, 0, 1), [0]).span_ns == circle.span_ns
    assert Descent(LANDING).span_ns == (0, 165_000_000_000)
    slow, fast = (Cycle(Fraction(1, seconds)) for seconds in (40, 8))
    assert Spinning((0, 0, 0), (0, 0, 1), fast).span_ns == (0, 8_000_000_000)
    assert Spinning((0, 0, 0), (0, 0, 1), fast, 0.1, slow).span_ns == (0, 40_000_000_000)
    assert Fixed().span_ns == (0, 0)


def test_instants_reach_the_end_of_each_path():
    board, landing = Fixed(), Descent(LANDING)
    assert instants_over([board, landing], 15_000_000_000, 4) == [15 * 10**9, 65 * 10**9, 115 * 10**9, 165 * 10**9]
    assert instants_over([board], 7, 3) == [7]
    day = Spinning((0, 0, 0), (0, 0, 1), Cycle(Fraction(1, 86_400)))
    assert instants_over([landing, day], 0, 3) == [0, 82_500_000_000, 165_000_000_000, 43_200 * 10**9, 86_400 * 10**9]
