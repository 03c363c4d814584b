"""`evstim demo landing`: what it says of the program's end; the flight itself is in tests/examples."""

import json
from pathlib import Path

import pytest

from emulator.cli import demo_landing
from emulator.cli.output import Failure

SOFT = {"soft": True, "t_s": 31.2, "vertical_m_s": 0.55, "error_median": 0.008}


@pytest.fixture
def program(monkeypatch, tmp_path):
    """A stand-in for fly.py that writes the given verdict and ends with the given code."""

    def made(verdict, code):
        file = tmp_path / "fly.py"
        write = f"pathlib.Path(sys.argv[-1], 'verdict.json').write_text({json.dumps(json.dumps(verdict))})"
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


def test_a_flight_without_end_is_a_failure(program):
    program(None, 3)
    with pytest.raises(Failure, match="ended with 3"):
        demo_landing.fly_landing(as_json=False)


def test_the_program_is_where_the_package_says():
    assert demo_landing._program().name == "fly.py"
