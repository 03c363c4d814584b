"""A law of the user's own: loaded, called and refused within bounds; flights with one are in the suite."""

import argparse
import threading
from pathlib import Path

import fly
import numpy as np
import pilot as pilot_module
import pytest
from pilot import LAW_FAILED, GivenLaw, LawFailed, LawInput, Pilot
from report import verdict
from sensors import PERIOD_S
from simple_law import Law
from spacecraft import Mission, TouchDown
from vehicle import GRAVITY_M_S2, State

STATE = LawInput(3.0, np.array([0.0, 1.0, 50.0]), np.array([0.1, 0.0, -5.0]), np.eye(4)[0], np.ones(3), np.ones(3), 0.2)


def law_of(folder, body):
    """Return FILE.py:law of a file whose law has this body."""
    (folder / "mine.py").write_text(f"def law(state):\n    {body}\n\n\nnumber = 3.0\n")
    return f"{folder / 'mine.py'}:law"


def test_a_law_is_a_function_or_a_class():
    """That of the example: 4 m/s at 50 m, one too fast, gain 1."""
    law = GivenLaw(f"{Path(fly.__file__).parent / 'simple_law.py'}:Law")
    assert law(STATE) == pytest.approx([0.0, 0.0, GRAVITY_M_S2 + 1.0])


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("return 1 / 0", "raised ZeroDivisionError: division by zero, in line 2 of mine.py"),
        ("raise SystemExit(3)", "raised SystemExit: 3, in line 2 of mine.py"),
        ("return 0.0, float('nan'), 1.62", "returned (0.0, nan, 1.62), not three finite numbers (east, north, up)"),
        ("return 1.62", "returned 1.62, not three finite numbers (east, north, up)"),
        ("return 'up'", "returned 'up', not three finite numbers (east, north, up)"),
        ("return None", "returned None, not three finite numbers (east, north, up)"),
        ("return 0, 0, 33", "returned (0, 0, 33), beyond 32 m/s2"),
        ("while True: pass", "did not return within 0.2 s"),
    ],
)
def test_a_law_that_fails_is_described(body, sentence, tmp_path, monkeypatch):
    """In one sentence, and without its exception; one that hangs is left behind, and ends with this test."""
    hangs, ended = body.startswith("while"), threading.Event()
    monkeypatch.setattr(pilot_module, "_CALL_S", 0.2 if hangs else 60.0)
    law = GivenLaw(law_of(tmp_path, "ended.wait()" if hangs else body))
    law._law.__globals__["ended"] = ended
    with pytest.raises(LawFailed) as failure:
        law(STATE)
    assert str(failure.value) == sentence
    assert not ended.is_set()
    ended.set()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("law", "is not FILE.py:NAME: give a file and the law's name in it, such as simple_law.py:Law"),
        ("nothing.py:law", "names no file: give the path of a file that exists"),
        ("mine.py:Law", "names nothing in mine.py: give a name that it defines: law"),
        ("mine.py:number", "cannot be called: give a function, or a class with a method __call__(self, state)"),
        ("broken.py:law", "raised SyntaxError: expected ':' (broken.py, line 2), in line 2 of broken.py"),
        ("lacking.py:law", "raised ModuleNotFoundError: No module named 'lacked', in line 1 of lacking.py"),
    ],
)
def test_a_wrong_name_is_refused_before_anything_starts(text, sentence, tmp_path, monkeypatch, capsys):
    """Exit code 2, why, what to do; no folder of a flight."""
    law_of(tmp_path, "return 0, 0, 1.62")
    (tmp_path / "broken.py").write_text("x = 1\ndef law(state)\n")
    (tmp_path / "lacking.py").write_text("import lacked\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["fly.py", "--out", "flight", "--guidance", text])
    with pytest.raises(SystemExit, match="2"):
        fly.main()
    assert f"fly.py: error: --guidance {text} {sentence}" in capsys.readouterr().err
    assert not (tmp_path / "flight").exists()


@pytest.mark.parametrize("more", [["--real-time"], ["--navigation", "given"], ["--compare"]])
def test_what_a_law_cannot_fly_with_is_refused(more, tmp_path, monkeypatch, capsys):
    """Without sensors of the vehicle there is no state from navigation."""
    monkeypatch.setattr("sys.argv", ["fly.py", "--out", str(tmp_path / "flight"), "--guidance", "mine.py:law", *more])
    with pytest.raises(SystemExit, match="2"):
        fly.main()
    assert "leave out" in capsys.readouterr().err


def test_the_pilot_flies_the_given_law():
    """Its command is the law's, decided from the state when the command acts; the law cannot change the filter."""
    states = []

    def law(state):
        states.append(state)
        command = Law()(state)
        state.position_m[:] = state.attitude[:] = np.nan
        return command

    flying = Pilot(Mission.drawn(100.0, 1).known, "blind", law)
    for number in range(1, 11):
        flying.filter.sample(number, np.zeros(3), np.array([0.0, 0.0, GRAVITY_M_S2 * PERIOD_S]))
    place, speed = flying.filter.now.position_m.copy(), flying.filter.now.velocity_m_s
    command = flying.command_m_s2(0.0, 0.2)
    assert states[0].t_s == pytest.approx(0.4)  # 0.1 s of delay and 0.1 s of the engine
    assert states[0].velocity_m_s == pytest.approx(speed)
    assert command[2] == pytest.approx(Law()(LawInput(0.4, place + speed * 0.2, speed, *[np.ones(3)] * 3, 0.2))[2])
    assert np.isfinite([*flying.filter.now.position_m, *flying.filter.now.attitude]).all()


def test_a_flight_whose_law_failed_is_not_good(tmp_path):
    """However softly the last command lands it."""
    end = TouchDown(30.0, State(np.zeros(3), np.array([0.0, 0.0, -0.5])), touched=True, fuel_kg=5.0)
    (tmp_path / "truth.csv").write_text("t_s,x_m,y_m,z_m,ground_m,vx_m_s,vy_m_s,vz_m_s\n")
    options = argparse.Namespace(navigation="events", guidance="mine.py:law", real_time=False, result=None)
    assert fly._report(end, verdict(end, tmp_path), options, tmp_path) == 0
    (tmp_path / LAW_FAILED).write_text("guidance mine.py:law raised ZeroDivisionError: division by zero")
    assert fly._report(end, verdict(end, tmp_path), options, tmp_path) == 1
