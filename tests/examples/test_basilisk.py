"""The example with Basilisk, run by Basilisk itself in an environment of its own."""

import json
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "firmware_protocol" / "ground"))

from own_environments import python_with

EXAMPLE = Path(__file__).parents[2] / "examples" / "basilisk"
START = "from emulator.cli import main; main()"
pytestmark = [pytest.mark.anew, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def basilisk(tmp_path_factory):
    return python_with("bsk==2.12.1", "EVSTIM_BSK_PYTHON", tmp_path_factory.mktemp("bsk") / "venv")


@contextmanager
def both(python, folder, seconds, *options, patience_s=600):
    """Start evstim and the simulation; yield both."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "cwd": folder}
    run = [sys.executable, "-c", START, "vizard", EXAMPLE / "eros.toml", "--at", "127.0.0.1:0", "--json", *options]
    with subprocess.Popen(run, **pipes) as evstim:
        port = evstim.stderr.readline().strip().rpartition(":")[2]
        program = [python, EXAMPLE / "simulation.py", "--port", port, "--seconds", str(seconds)]
        program += ["--patience", str(patience_s)]
        with subprocess.Popen(program, **pipes) as simulation:
            try:
                yield evstim, simulation
            finally:
                simulation.kill()
                evstim.kill()


def told_by(evstim):
    out, err = evstim.communicate(timeout=600)
    assert out, err
    return evstim.returncode, json.loads(out.splitlines()[-1])


def met(evstim):
    """Return when the simulation's first update has come."""
    told = []
    for line in evstim.stderr:
        told.append(line)
        if "Basilisk is here" in line:
            return
    raise AssertionError("".join(told))


@pytest.mark.long
def test_a_spacecraft_finds_eros_in_our_images(basilisk, tmp_path):
    with both(basilisk, tmp_path, 6.0) as (evstim, simulation):
        _, err = simulation.communicate(timeout=600)
        assert simulation.returncode == 0, err
        code, told = told_by(evstim)
    seen = json.loads((tmp_path / "simulation.json").read_text())
    assert (code, told["problems"], told["balanced"]) == (0, [], True)
    counts = told["basilisk"]
    assert (counts["updates"], counts["images"], counts["refused"], seen["images"]) == (150, 150, 0, 150)
    # No drift: to the nanosecond the time that the simulation says it has reached.
    assert (counts["first_ns"], counts["last_ns"]) == (40_000_000, seen["nanoseconds"])
    assert told["sim_seconds"] == pytest.approx(5.96, abs=1e-9)
    # In the images the light goes to the middle, by the way that the simulation's true states tell.
    true, light = (np.array([seen[of]["first"], seen[of]["last"]]).reshape(2, 2) for of in ("true_px", "light_px"))
    assert np.abs(true[0]).max() > 60
    assert np.abs(light[1]).max() < 20
    assert light[1] - light[0] == pytest.approx(true[1] - true[0], abs=1.0)
    assert told["events"]["links"]["loopback"]["delivered"] > 100_000


@pytest.mark.long
def test_the_run_ends_when_basilisk_is_killed(basilisk, tmp_path):
    with both(basilisk, tmp_path, 1000.0, "--seconds", "900") as (evstim, simulation):
        met(evstim)
        simulation.kill()
        code, told = told_by(evstim)
    assert code == 1
    assert len(told["problems"]) == 1
    assert told["problems"][0].startswith("the simulation ended after")


@pytest.mark.long
def test_basilisk_ends_when_evstim_is_stopped(basilisk, tmp_path):
    with both(basilisk, tmp_path, 1000.0) as (evstim, simulation):
        met(evstim)
        evstim.send_signal(signal.SIGINT)
        _, err = simulation.communicate(timeout=600)
        assert simulation.returncode == 1
        assert "Error processing SIM_UPDATE" in err
        code, told = told_by(evstim)
    assert (code, told["problems"]) == (0, [])


@pytest.mark.long
def test_basilisk_ends_when_evstim_is_killed(basilisk, tmp_path):
    with both(basilisk, tmp_path, 1000.0, patience_s=30) as (evstim, simulation):
        met(evstim)
        evstim.kill()
        simulation.communicate(timeout=600)
        assert simulation.returncode == -signal.SIGALRM
