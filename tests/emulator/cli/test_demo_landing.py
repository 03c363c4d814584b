"""`evstim demo landing`: what it says of the program's end; the flight itself is in tests/examples."""

import json
from pathlib import Path

import pytest

from emulator.cli import demo as demo_landing
from emulator.cli.app import _main
from emulator.cli.output import Failure

SOFT = {"soft": True, "touched": True, "t_s": 31.2, "vertical_m_s": 0.55, "error_median": 0.008, "why": []}


@pytest.fixture
def program(monkeypatch, tmp_path):
    """A stand-in for fly.py that writes the given verdict and ends with the given code."""

    def made(verdict, code):
        file = tmp_path / "fly.py"
        write = f"pathlib.Path(sys.argv[-1], 'verdict.json').write_text({json.dumps(json.dumps(verdict))})"
        write += f"; pathlib.Path({str(tmp_path / 'arguments')!r}).write_text(' '.join(sys.argv[1:-1]))"
        file.write_text(f"import pathlib, sys\n{write if verdict else ''}\nsys.exit({code})\n")
        monkeypatch.setattr(demo_landing, "_program", lambda: file)

    return made


@pytest.mark.parametrize(("verdict", "code"), [(SOFT, 0), ({**SOFT, "soft": False, "vertical_m_s": 7.0}, 1)])
def test_the_verdict_of_the_flight_is_the_exit_code(program, capfd, verdict, code):
    program(verdict, code)
    assert demo_landing.fly_landing(as_json=True) == code
    told = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert told["vertical_m_s"] == verdict["vertical_m_s"]
    assert told["good"] is verdict["soft"]
    assert Path(told["folder"]).is_dir()


@pytest.mark.parametrize(("code", "told"), [(3, 3), (2, 2), (-9, 1)])
def test_a_flight_that_did_not_begin_is_a_failure(program, code, told):
    program(None, f"{code}" if code > 0 else "__import__('os').kill(__import__('os').getpid(), 9)")
    with pytest.raises(Failure, match=f"ended with {code}") as failure:
        demo_landing.fly_landing(as_json=False)
    assert failure.value.exit_code == told


def test_people_are_told_what_went_wrong(program, capfd):
    program({"soft": False, "touched": False, "t_s": 9.0, "vertical_m_s": 2.0, "why": ["evstim has ended"]}, 1)
    assert demo_landing.fly_landing(as_json=False) == 1
    out = capfd.readouterr().out
    assert "evstim has ended" in out
    assert "touchdown" not in out


@pytest.mark.parametrize(
    ("given", "passed"), [([], "--compare"), (["--guidance", "my.py:Law"], "--guidance my.py:Law")]
)
def test_a_law_goes_to_the_program(program, tmp_path, given, passed):
    program(SOFT, 0)
    assert _main(["demo", "landing", *given]) == 0
    assert (tmp_path / "arguments").read_text() == f"--height 500.0 {passed} --out"


def test_a_law_without_a_landing_is_refused(capsys):
    assert _main(["demo", "eros", "--guidance", "my.py:Law"]) == 2
    assert "eros has no guidance: give --guidance with `evstim demo landing`" in capsys.readouterr().err


def test_the_program_is_where_the_package_says():
    assert demo_landing._program().name == "fly.py"
