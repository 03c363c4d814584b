"""The programs of examples/ run, at small sizes, outside the checkout's folder."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_every_example_is_tested():
    text = Path(__file__).read_text()
    programs = [path.name for path in EXAMPLES.iterdir() if path.suffix in (".py", ".ipynb")]
    assert [name for name in programs if name not in text] == []


def main_of(name, monkeypatch, folder):
    monkeypatch.chdir(folder)
    return runpy.run_path(str(EXAMPLES / name))["main"]


def test_frames_to_events(monkeypatch, tmp_path):
    main = main_of("frames_to_events.py", monkeypatch, tmp_path)
    count = main()
    assert count > 1000
    assert len(np.load("events.npz")["events"]) == count
    np.save("mine.npy", np.array([20, 200], np.uint8)[:, None, None] * np.ones((1, 8, 8), np.uint8))
    assert main("mine.npy") > 64


def test_own_mesh(monkeypatch, tmp_path):
    main = main_of("own_mesh.py", monkeypatch, tmp_path)
    assert main(None, "0.05") > 100
    assert main("spacecraft.obj", "0.02") > 10


def test_read_recording(monkeypatch, tmp_path):
    assert main_of("read_recording.py", monkeypatch, tmp_path)() > 1e4


def test_a_flight_software_test():
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", EXAMPLES / "test_flight_software.py"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout


def test_the_cells_of_pixel_response():
    notebook = json.loads((EXAMPLES / "pixel_response.ipynb").read_text())
    assert all(not cell.get("outputs") for cell in notebook["cells"]), "kept without outputs"
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(cells) >= 3
    names = {}
    for cell in cells:
        exec(compile(cell, "pixel_response.ipynb", "exec"), names)
