"""The tutorial: its programs on one running rig, and its page, which prints them as they are."""

import re
import runpy
import subprocess
import sys
import time
from pathlib import Path

import pytest

import firmware_protocol.c
from evstim.testing.running_rig import RunningRig

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples/tutorial"
PAGE = (ROOT / "docs/tutorial.md").read_text(encoding="utf-8")


def test_the_page_prints_the_programs():
    programs = [path.read_text() for path in FOLDER.iterdir() if path.suffix in (".py", ".c", ".toml")]
    blocks = re.findall(r"^```(?:python|c|toml)\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert len(blocks) >= 4
    assert [block for block in blocks if not any(block in program for program in programs)] == []


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
