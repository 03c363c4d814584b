"""The parts of the landing, each against a closed form or an independent computation: `pytest test_parts.py`."""

import math
import struct

import guidance as guidance_module
import numpy as np
import pytest
from divergence import Lens, Motion, Rays, Window, estimate
from frames import pack_attitude, pack_command, unpack_attitude, unpack_command
from guidance import Guidance
from vehicle import GRAVITY_M_S2, Lander, State, advance, matrix


def test_a_vertical_burn_gives_the_speed_of_the_rocket_equation():
    """Thrust that is there from the start, straight up: v = Isp g0 ln(m0 / m) - g t."""
    lander, command = Lander(), np.array([0.0, 0.0, 3.0])
    start = State(np.array([0.0, 0.0, 100.0]), np.zeros(3), thrust_n=3000.0)
    end = advance(lander, start, command, 5.0)
    assert end.velocity_m_s[2] == pytest.approx(
        lander.isp_s * 9.80665 * math.log(start.mass_kg / end.mass_kg) - GRAVITY_M_S2 * 5, rel=1e-9
    )
    assert end.mass_kg == pytest.approx(1000 - 3000 * 5 / (310 * 9.80665), rel=1e-9)


def flowing(theta, n=6000):
    """Return events of points that flow exactly, at random times of a second, addresses spread over a pixel."""
    draw = np.random.default_rng(4)
    points = draw.uniform(-0.5, 0.5, (2, 150))[:, draw.integers(0, 150, n)]
    t = np.sort(draw.uniform(0, 1, n))
    u, v, w = theta
    shift = (t - 0.5)[None]
    moved = points + shift * (points * w - np.array([[u], [v]]))
    return Rays(t, *(moved + draw.uniform(-0.5, 0.5, (2, n)) / 300), np.ones(n), (-0.6, 0.6, -0.6, 0.6))


@pytest.mark.parametrize("theta", [(0.0, 0.0, 0.08), (0.01, -0.02, 0.05), (-0.03, 0.0, 0.15)])
def test_the_motion_of_points_is_found(theta):
    """All three unknowns, from a guess that is off by a third."""
    guess = Motion(0.0, 0.0, theta[2] / 1.5, math.inf, 0.0, 0)
    found = estimate(flowing(theta), guess, 0.06, 300.0, (200.0, 200.0))
    assert found.down == pytest.approx(theta[2], rel=0.02)
    assert (found.east, found.south) == pytest.approx(theta[:2], abs=0.001)
    assert found.reliable


def falling(waves_px, divergence_1_s, contrast):
    """Return what ideal pixels (threshold 0.25) see of waves on the ground while the camera falls at constant speed.

    ln L = a(X) + b(Y), a and b sums of ten sines, X and Y places on the ground: x h(t) / h(0) at time t. Levels are
    crossed between instants a tenth of a pixel of motion apart; the first of two seconds settles the pixels.
    """
    draw, size, focal_px, threshold = np.random.default_rng(3), 160, 150.0, 0.25
    places = (np.arange(size) - size / 2 + 0.5) / focal_px
    per_rad = 2 * np.pi * focal_px / draw.uniform(*waves_px, (2, 10, 1))
    phases = draw.uniform(0, 2 * np.pi, (2, 10, 1))

    def light(t_s):
        a, b = (contrast / math.sqrt(10) * np.sin(per_rad * places * (1 - divergence_1_s * t_s) + phases)).sum(axis=1)
        return a[None] + b[:, None]

    times = np.linspace(-1.5, 0.5, int(divergence_1_s * size * 10))
    reference, found = light(times[0]), []
    for t_s in times[1:]:
        steps = np.trunc((light(t_s) - reference) / threshold)
        reference = reference + threshold * steps
        if t_s > -0.5:
            rows, columns = np.nonzero(steps)
            found.append(np.stack([np.full(len(rows), t_s), columns, rows, np.sign(steps[rows, columns])]))
    t, x, y, sign = np.concatenate(found, axis=1)
    x, y = ((c + draw.random(len(c)) - size / 2) / focal_px for c in (x, y))
    edge = size / 2 / focal_px
    return Rays(t, x, y, sign, (-edge, edge, -edge, edge))


def error_of(rays, divergence_1_s):
    """Return the relative error of the divergence."""
    guess = Motion(0.0, 0.0, 0.9 * divergence_1_s, math.inf, 0.0, 0)
    return estimate(rays, guess, 0.04, 150.0, (90.0, 90.0)).down / divergence_1_s - 1


@pytest.mark.parametrize("waves_px", [(5.0, 10.0), (8.0, 30.0), (30.0, 60.0)])
def test_the_divergence_has_no_bias(waves_px):
    """Fine, mixed and smooth ground, 6 pixels of motion at the edge; what is left is that of 3 to 30 waves."""
    assert abs(error_of(falling(waves_px, 0.08, 0.8), 0.08)) < 0.03


def test_noise_is_not_reliable():
    """Events at random places and times, of random signs or all ON."""
    draw = np.random.default_rng(1)
    t, x, y = np.sort(draw.uniform(0, 1.2, 8000)), draw.uniform(-0.57, 0.57, 8000), draw.uniform(-0.43, 0.43, 8000)
    for sign in (draw.choice([-1.0, 1.0], 8000), np.ones(8000)):
        rays = Rays(t, x, y, sign, (-0.57, 0.57, -0.43, 0.43))
        assert not estimate(rays, Motion(0, 0, 0.08, math.inf, 0.0, 0), 0.05, 300.0, (173.0, 130.0)).reliable


def test_rays_are_level_whatever_the_attitude():
    """A point on the ground seen by a tilted camera has the ray of a level one."""
    lens, tilt = Lens(), np.array([math.cos(0.05), math.sin(0.05), 0.0, 0.0])
    ray = np.array([0.2, -0.1, -1.0])  # east, north, up
    body = matrix(tilt).T @ ray
    x, y = (-body[0] / body[2] * lens.focal_px + 173, body[1] / body[2] * lens.focal_px + 130)
    window = Window(lens, 1)
    events = np.zeros(2000, [("t", "u8"), ("x", "u2"), ("y", "u2"), ("on", "?")])
    events["t"], events["x"], events["y"] = np.arange(2000) * 400, int(x), int(y)
    window.add_events(events)
    rays = window.rays(0.0, 1.0, [(0.0, tilt), (1.0, tilt)])
    half_x, half_y, angle = 173 / lens.focal_px, 130 / lens.focal_px, math.atan(130 / lens.focal_px)
    across = half_x / (math.cos(0.1) + half_y * math.sin(0.1))
    assert rays.seen == pytest.approx((-across, across, math.tan(-angle - 0.1), math.tan(angle - 0.1)))
    assert (rays.x.mean(), rays.y.mean()) == pytest.approx((0.2, 0.1), abs=1 / lens.focal_px)


def test_a_motion_that_jumps_is_not_accepted():
    """A window that shows nothing, and ones that show far more than was predicted, change nothing.

    Half the difference of one that agrees is applied: after a second at 8 m/s the divergence is 8 / 92.
    """
    guidance = Guidance(100.0, np.array([0.0, 0.0, -8.0]))
    for motion in (Motion(0, 0, 0.08, 1.0, 1.0, 9), Motion(0, 0, -0.2, 2.0, 1.0, 9), Motion(0.2, 0, 0.08, 2.0, 1.0, 9)):
        guidance.take_motion(motion, 1.0, 1.0)
        assert guidance.motion.gain == math.inf
    guidance.take_motion(Motion(0, 0, 0.09, 1.5, 1.0, 9), 1.0, 1.0)
    assert guidance.motion.down == pytest.approx((0.09 + 8 / 92) / 2)


def test_falling_too_fast_asks_for_more_thrust():
    """The command is that of constant divergence, and more above it; predicted for 0.2 s of delay and engine."""
    guidance = Guidance(50.0, np.array([0.0, 0.0, -4.0]))
    steady = 0.08**2 * 50 + GRAVITY_M_S2
    assert guidance.command_m_s2(0.0, 0.0)[2] == pytest.approx(steady + 50 * (4 / 49.2 - 0.08))
    guidance.take_motion(Motion(0, 0, 0.09, 1.5, 0.0, 9), 0.0, 0.2)
    assert guidance.command_m_s2(0.0, 0.0)[2] == pytest.approx(steady + 50 * (4.25 / 49.15 - 0.08))


def test_without_motion_dead_reckoning_takes_over(monkeypatch):
    """Without a motion for ten seconds, a vehicle that follows its commands is at the reckoned place, upright.

    Its divergence D nears that wanted, W, by D' = (D - W) (D + W - k), k being 0.8 / (t + 0.2 s), at most 1.
    """
    monkeypatch.setattr(guidance_module, "_HOLD_S", 0.0)
    guidance, step_s = Guidance(100.0, np.array([1.0, 0.0, -5.0])), 0.05
    height_m, speed_m_s = 100.0, 5.0
    for k in range(1, 200):
        command = guidance.command_m_s2(k * step_s, step_s)
        assert guidance.lost(k * step_s)
        assert command[:2] == pytest.approx([0.0, 0.0])
        height_m -= speed_m_s * step_s
        speed_m_s -= (command[2] - GRAVITY_M_S2) * step_s
    assert guidance.height_m == pytest.approx(height_m, rel=0.02)
    divergence_1_s = 0.05
    for t_s in np.arange(0.0, 9.95, 0.01):
        divergence_1_s += (divergence_1_s - 0.08) * (divergence_1_s + 0.08 - min(1.0, 0.8 / (t_s + 0.2))) * 0.01
    assert speed_m_s / height_m == pytest.approx(divergence_1_s, rel=0.02)


def test_frames_carry_what_was_put_in():
    """To a millimetre a second squared, and a 32767th."""
    command, turn = unpack_command(pack_command(np.array([0.1234, -2.5, 40.0]), 70000))
    assert command == pytest.approx([0.123, -2.5, 32.767])
    assert turn == 70000 % 65536
    q, number = unpack_attitude(pack_attitude(-np.array([0.98, 0.1, -0.1, 0.14]), 7))
    assert (q, number) == (pytest.approx([0.98, 0.1, -0.1, 0.14], abs=5e-4), 7)
    with pytest.raises(struct.error, match="8 bytes"):
        unpack_command(b"abc")
