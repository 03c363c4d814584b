"""Descents in ELOPE's layout: the poses by their derivatives, the score by hand, a short descent solved."""

import json
import math
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


def test_speeds_are_the_derivatives_of_place_and_attitude(elope):
    descent, step_s = elope.Descent(5), 1e-4
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


@pytest.fixture
def refused(elope, tmp_path, capsys):
    """Run a command on tmp_path and v.json, which ends with 2; return its message."""

    def run(command):
        with pytest.raises(SystemExit) as ended:
            elope.main(command, str(tmp_path), *([] if command == "table" else [str(tmp_path / "v.json")]))
        printed = capsys.readouterr()
        assert (ended.value.code, printed.out) == (2, "")
        return printed.err

    return run


def test_wrong_files_are_refused_with_the_reason(elope, tmp_path, refused):
    assert "no file 0000" in refused("score")
    np.savez(tmp_path / "0003.npz", events=np.zeros(0, elope.EVENT))
    assert "timestamps, traj, range_meter missing" in refused("solve")
    good = a_sequence(elope)._asdict()
    for name, wrong in (
        ("traj", good["traj"][:, :6]),
        ("traj", good["traj"].astype(str)),
        ("timestamps", np.float64(3.0)),
        ("timestamps", good["timestamps"] * np.nan),
        ("range_meter", np.array([[0.1, np.inf]])),
        ("events", np.zeros((3, 4))),
        ("events", np.array([{}], object)),
    ):
        np.savez(tmp_path / "0003.npz", **{**good, name: wrong})
        for command in ("solve", "table"):
            message = refused(command)
            assert "0003.npz" in message
            assert name in message or "pickle" in message
    for content in (b"", b"PK\x03\x04 cut", (tmp_path / "0003.npz").read_bytes()[:900]):
        (tmp_path / "0003.npz").write_bytes(content)
        assert "0003.npz" in refused("solve")


ZEROS = [0.0] * 120


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ({"3": {"vx": ZEROS[1:], "vy": ZEROS[1:], "vz": ZEROS[1:]}}, "sequence 3: 120 finite numbers of each"),
        ({"3": {"vx": ZEROS, "vy": [*ZEROS[1:], math.nan], "vz": ZEROS}}, "each are needed; vy[119] is nan"),
        ({"3": {"vx": [1e308] * 120, "vy": [1e308] * 120, "vz": ZEROS}}, "its score is inf"),
        ({"3": {"vx": [None, *ZEROS[1:]], "vy": ZEROS, "vz": ZEROS}}, "got `null` - at `$[...].vx[0]`"),
        ({"3": {"vx": ZEROS, "vy": ZEROS}}, "missing required field `vz`"),
        ({"3": [ZEROS, ZEROS, ZEROS]}, "expected lists vx, vy and vz by the sequence's number"),
        ({}, "no answer to sequence 3"),
        ({key: {"vx": ZEROS, "vy": ZEROS, "vz": ZEROS} for key in "34"}, "there is no sequence 4"),
        ("\xff", "decode"),
        ("[" * 100_000, "recursion"),
    ],
)
def test_wrong_answers_are_named(elope, tmp_path, refused, answers, message):
    np.savez(tmp_path / "0003.npz", **a_sequence(elope)._asdict())
    text = answers if isinstance(answers, str) else json.dumps(answers)
    (tmp_path / "v.json").write_bytes(text.encode("latin-1"))
    said = refused("score")
    assert f"{tmp_path / 'v.json'}: " in said
    assert message in said


@pytest.mark.parametrize(("column", "value"), [(2, 0.0), (4, np.nan)])
def test_a_sequence_without_its_true_motion_has_no_score(elope, tmp_path, refused, column, value):
    sequence = a_sequence(elope)
    sequence.traj[7, column] = value
    np.savez(tmp_path / "0003.npz", **sequence._asdict())
    (tmp_path / "v.json").write_text(json.dumps({"3": dict.fromkeys(("vx", "vy", "vz"), ZEROS)}))
    assert "sequence 3: its traj lacks velocities, or heights above 0" in refused("score")
    assert "0003.npz: its traj lacks" in refused("table")


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
    assert f"mean of 1 sequence: {elope.score(loaded, elope.solve(loaded)):.4f}" in capsys.readouterr().out
    elope.main("table", str(tmp_path))
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"| {tmp_path.name} | 1 ms | - | ")
