"""The tutorial: its programs on one running rig, and its page, which prints them as they are."""

import importlib
import re
import runpy
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

import firmware_protocol.c
from evstim.testing.running_rig import RunningRig
from firmware_protocol.events import EVENT

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples/tutorial"
PAGE = (ROOT / "docs/tutorial.md").read_text(encoding="utf-8")


def test_the_page_prints_the_programs():
    programs = [path.read_text() for path in FOLDER.iterdir() if path.suffix in (".py", ".c", ".toml")]
    blocks = re.findall(r"^```(?:python|c|toml)\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert len(blocks) >= 4
    assert [block for block in blocks if not any(block in program for program in programs)] == []


def test_the_rest_of_a_window_is_no_position(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    flight_code = importlib.import_module("centroid")
    parts = [events_at(0, x=10, count=150), events_at(100_000, x=170, count=3_000), events_at(200_000, x=10, count=1)]
    monkeypatch.setattr(flight_code, "SerialReceiver", lambda _: Mock(take_events=Mock(side_effect=parts)))
    monkeypatch.setattr(flight_code.serial, "Serial", Mock(return_value=Mock(in_waiting=0)))
    centroid = flight_code.Centroid("port")
    centroid.poll()
    centroid.poll()
    assert (centroid.is_fresh, centroid.windows) == (False, 0)  # 150 events that came after the line opened
    centroid.poll()
    assert (centroid.is_fresh, centroid.windows, centroid.x, centroid.y) == (True, 1, 170.0, 120.0)


def events_at(t_us, x, count):
    return np.array([(t_us, x, 120, True)] * count, EVENT)


@pytest.mark.system
def test_the_programs_with_a_fault(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(FOLDER)
    survives = runpy.run_path(str(FOLDER / "test_centroid.py"))["test_the_centroid_survives_an_unplugged_line"]
    library = Path(firmware_protocol.c.FOLDER)
    sources = [library / f"evstim_{part}.c" for part in ("crc", "frames", "block", "telemetry")]
    build = ["cc", "-std=gnu99", "-I", library, "-o", tmp_path / "centroid", FOLDER / "centroid.c"]
    subprocess.run([*build, *sources], check=True)
    with RunningRig(FOLDER / "asteroid.toml", tmp_path) as rig:
        survives(rig)
        for command in ([sys.executable, FOLDER / "first_try.py", rig.address], [tmp_path / "centroid"]):
            assert end_without_a_line(rig, command) == 1
    assert rig.result.good or rig.result.too_late


def end_without_a_line(rig, command):
    """Unplug the line once a program has printed a position; return its exit code."""
    end_s = time.monotonic() + 30
    while not Path(rig.address).exists():  # it comes back from the fault before
        assert time.monotonic() < end_s
        time.sleep(0.01)
    with (
        Path(rig.address).open("rb") as port,
        subprocess.Popen(command, stdin=port, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as program,
    ):
        assert "x " in program.stdout.readline()
        rig.inject("unplugged", for_s=0.5)
        program.communicate(timeout=60)
    return program.returncode
