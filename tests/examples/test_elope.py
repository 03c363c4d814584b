"""Descents in ELOPE's layout: the poses by their derivatives, the score by hand, a short descent solved."""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.system

PROGRAM = Path(__file__).parents[2] / "examples" / "elope" / "elope.py"


@pytest.fixture(scope="module")
def elope():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(PROGRAM.parents[1] / "landing"))
        yield type("Program", (), runpy.run_path(str(PROGRAM)))


@pytest.mark.parametrize("seed", [0, 1, 5, 27])
def test_speeds_are_the_derivatives_of_place_and_attitude(elope, seed):
    descent, step_s = elope.Descent(seed), 1e-4
    first, last = descent.at(0.0), descent.at(descent.seconds)
    assert 2000 < first[2] < 3000
    assert 130 < last[2] < 170
    for t_s in (3.0, 17.0, 39.0):
        before, now, after = (descent.at(t_s + shift) for shift in (-step_s, 0.0, step_s))
        np.testing.assert_allclose(now[3:6], (after[:3] - before[:3]) / (2 * step_s), rtol=1e-4, atol=1e-4)
        turned = [Rotation.from_euler("ZYX", row[[8, 7, 6]]) for row in (before, after)]
        np.testing.assert_allclose(now[9:], (turned[0].inv() * turned[1]).as_rotvec() / (2 * step_s), atol=1e-6)
        w, x, y, z = elope.body_attitude(now[6:9])
        agreed = Rotation.from_quat([x, y, z, w]) * Rotation.from_euler("ZYX", now[[8, 7, 6]]).inv()
        assert agreed.magnitude() < 1e-9


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.1, -0.2, 0.3)])
def test_the_camera_looks_down_the_body_with_its_top_to_the_north(elope, angles):
    row = np.array([0.0, 0.0, 100.0, 0.0, 0.0, 0.0, *angles, 0.0, 0.0, 0.0])
    w, x, y, z = elope.camera_pose(row).q_world_from_body
    ahead, right, top = Rotation.from_quat([x, y, z, w]).apply([[0, 0, 1], [1, 0, 0], [0, -1, 0]])
    body = Rotation.from_euler("ZYX", angles[::-1])
    np.testing.assert_allclose([ahead, right, top], body.apply([[0, 0, -1], [1, 0, 0], [0, 1, 0]]), atol=1e-12)


def a_sequence(elope):
    times = np.linspace(0, 11.9, 120)
    traj = np.zeros((120, 12))
    traj[:, 2], traj[:, 5] = 100.0, -10.0
    return elope.Sequence(np.zeros(0, elope.EVENT), times, traj, np.array([[0.1, 100.0]]))


def test_the_score_is_the_error_over_the_height(elope):
    sequence = a_sequence(elope)
    velocities = sequence.traj[:, 3:6] + np.array([3.0, 4.0, 0.0])
    assert elope.score(sequence, velocities) == pytest.approx(0.05)
    velocities[:60] = sequence.traj[:60, 3:6]
    assert elope.score(sequence, velocities) == pytest.approx(0.025)
    for wrong in (velocities[1:], velocities * np.nan):
        with pytest.raises(ValueError, match="120 finite numbers"):
            elope.score(sequence, wrong)


def test_wrong_files_are_refused_with_the_reason(elope, tmp_path):
    with pytest.raises(SystemExit, match="no file 0000"):
        elope.main("score", str(tmp_path), "v.json")
    np.savez(tmp_path / "0003.npz", events=np.zeros(0, elope.EVENT))
    with pytest.raises(ValueError, match="timestamps, traj, range_meter missing"):
        elope.main("solve", str(tmp_path), str(tmp_path / "v.json"))
    np.savez(tmp_path / "0003.npz", **a_sequence(elope)._asdict())
    (tmp_path / "v.json").write_text(json.dumps({"3": {"vx": [0.0] * 119, "vy": [0.0] * 119, "vz": [0.0] * 119}}))
    with pytest.raises(SystemExit, match="sequence 3: velocities: 120 finite numbers"):
        elope.main("score", str(tmp_path), str(tmp_path / "v.json"))


@pytest.mark.long
def test_the_last_seconds_of_a_descent_made_and_solved(elope, tmp_path, capsys):
    """Its events, ranges and score: below 10 % of the height a second, with times of whole milliseconds too."""

    class End(elope.Descent):
        """From 330 m to 225 m."""

        seconds = 7.0

        def at(self, t_s):
            return super().at(t_s + 36.0)

    sequence = elope.fly(End(1))
    assert sequence.traj.shape == (120, 12)
    assert len(sequence.events) > 5_000
    assert np.all(np.diff(sequence.events["t"]) >= 0)
    assert len(np.unique(sequence.events["t"] % 1000)) > 900  # no frames of a millisecond
    truth = np.interp(sequence.range_meter[:, 0], sequence.timestamps, sequence.traj[:, 2])
    np.testing.assert_allclose(sequence.range_meter[:, 1], truth, rtol=0.03)
    np.savez(tmp_path / "0001.npz", **sequence._asdict())
    loaded = elope.Sequence.load(tmp_path / "0001.npz")
    for tick_us in (1, 1000):
        assert elope.score(loaded, elope.solve(loaded, tick_us)) < 0.03
    assert elope.score(loaded, np.zeros((120, 3))) > 0.05
    elope.main("solve", str(tmp_path), str(tmp_path / "v.json"))
    capsys.readouterr()
    elope.main("score", str(tmp_path), str(tmp_path / "v.json"))
    assert f"mean of 1 sequences: {elope.score(loaded, elope.solve(loaded)):.4f}" in capsys.readouterr().out
    elope.main("table", str(tmp_path))
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"| {tmp_path.name} | 1 ms | - | ")
