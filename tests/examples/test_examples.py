"""The programs of examples/ run, at small sizes; tests that they have run in their folders, as for a user."""

import json
import runpy
import shutil
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
import trimesh
from gymnasium.utils.env_checker import check_env

import evstim

pytestmark = pytest.mark.system

EXAMPLES = Path(__file__).parents[2] / "examples"
PYTEST = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:timeout"]  # users lack it


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


@pytest.mark.long
def test_own_mesh(monkeypatch, tmp_path):
    main = main_of("own_mesh.py", monkeypatch, tmp_path)
    assert main(None, "0.05") > 100
    trimesh.load_mesh("spacecraft.obj").export("spacecraft.glb")
    assert main("spacecraft.glb", "0.02") > 10


def test_read_recording(monkeypatch, tmp_path):
    assert main_of("read_recording.py", monkeypatch, tmp_path)() > 1e4


@pytest.mark.long
def test_learn_flow(monkeypatch, tmp_path):
    """From twelve sequences a network learns some of the flow of four others; with the default of 96, half of it."""
    main = main_of("learn_flow.py", monkeypatch, tmp_path)
    with evstim.run("loopback", seconds=0.1, pace="free", record="mine.npz") as run:
        run.wait()
    medians = main("--sequences", "16", "--recording", "mine.npz")
    assert medians["network"] < 0.95 * min(medians["no flow"], medians["mean flow"])
    assert (tmp_path / "flow.png").stat().st_size > 10_000


@pytest.mark.sampled
@pytest.mark.parametrize("rig", ["rendezvous", "itokawa"])
def test_plot_truth(rig, monkeypatch, tmp_path):
    assert main_of("truth/plot_truth.py", monkeypatch, tmp_path)(rig, "0.2", "plot.png") > 1000
    assert (tmp_path / "plot.png").stat().st_size > 30_000


@pytest.mark.long
def test_a_flight_software_test():
    command = [*PYTEST, "test_flight_software.py"]
    done = subprocess.run(command, cwd=EXAMPLES, capture_output=True, text=True, timeout=300)
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


@pytest.mark.long
def test_the_flight_software_project(tmp_path):
    """As its README says, in its folder."""
    points = entry_points(group="pytest11")
    plugin = [] if any(point.value == "evstim.testing.plugin" for point in points) else ["-p", "evstim.testing.plugin"]
    command = [*PYTEST, *plugin, "--evstim-artefacts", tmp_path / "artefacts"]
    done = subprocess.run(command, cwd=EXAMPLES / "flight_software", capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout
    assert "4 passed" in done.stdout
    assert not (tmp_path / "artefacts").exists()


@pytest.mark.long
def test_the_campaign(tmp_path):
    """As its README says, in a copy of its folder, with fewer runs."""
    folder = tmp_path / "campaign"
    shutil.copytree(EXAMPLES / "campaign", folder)
    file = folder / "speed.toml"
    file.write_text(file.read_text().replace("count = 64", "count = 12"))
    evstim = [sys.executable, "-c", "from emulator.cli import main; main()", "campaign"]
    done = subprocess.run([*evstim, "speed.toml", "--json"], cwd=folder, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["outcomes"] == {"ok": 12}
    assert 4 <= told["success"]["successes"] < 12, "the estimate is good without noise, and bad with much of it"
    assert (folder / "speed" / "report.html").stat().st_size > 50_000
    again = [*evstim, "again", "speed.toml", "7", "--record", "seven.npz"]
    done = subprocess.run(again, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "equal to the row of the campaign" in done.stdout
    assert len(np.load(folder / "seven.npz")["events"]) > 100


def test_the_parts_of_the_landing():
    """In a process of their own: the example's modules have short names."""
    done = subprocess.run(
        PYTEST[:-2], cwd=Path(__file__).parent / "landing", capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout
    assert "65 passed" in done.stdout


def landing(out, *more):
    """Fly the last metres over the real serial line, bus and poses; return exit code, verdict and what was printed."""
    command = [sys.executable, EXAMPLES / "landing" / "fly.py", "--height", "5", "--out", out, *more]
    done = subprocess.run(command, capture_output=True, text=True, timeout=550)
    file = out / "verdict.json"
    verdict = json.loads(file.read_text()) if file.exists() else None
    return done.returncode, verdict, done.stdout + done.stderr


def without_times(out):
    """Return the turns of the flight computer without their computing times."""
    turns = [json.loads(line) for line in (out / "computer.jsonl").read_text().splitlines()]
    return [{name: turn[name] for name in turn.keys() - {"began_ns", "ended_ns"}} for turn in turns]


@pytest.mark.long
@pytest.mark.socket
def test_a_short_landing_twice(tmp_path):
    """The law has no least speed of touchdown: that it lands, in the bounds, and equally to the last digit."""
    (code, verdict, text), (_, again, _) = (landing(tmp_path / name) for name in ("first", "second"))
    assert code == 0, text
    assert 0 < verdict["vertical_m_s"] < 1
    assert verdict["why"] == []
    assert again == verdict
    assert without_times(tmp_path / "second") == without_times(tmp_path / "first")
    assert (tmp_path / "second" / "truth.csv").read_text() == (tmp_path / "first" / "truth.csv").read_text()


@pytest.mark.long
@pytest.mark.socket
def test_a_short_landing_in_real_time(tmp_path):
    """How well it lands, or whether it begins, depends on the machine; that its files agree does not.

    A machine that stands still for seconds may begin the descent without the flight computer, which then has no file.
    """
    code, verdict, text = landing(tmp_path, "--real-time", "--longest-s", "40")
    assert code in (0, 1), text
    assert verdict["soft"] == (code == 0)
    told = json.loads((tmp_path / "summary.json").read_text().splitlines()[-1])
    assert told["lateness"]["lead_needed_us"]["p50"] > 0
    not_flown = ("did not begin", "answered no SYNC")
    flown = not any(reason in sentence for reason in not_flown for sentence in verdict["why"])
    assert flown == (tmp_path / "latency.json").exists(), text
    if flown:
        parts = json.loads((tmp_path / "latency.json").read_text())["parts_ms"]
        assert all(part["median"] >= 0 for part in parts.values() if part["median"] is not None)


@pytest.mark.long
@pytest.mark.socket
def test_a_flight_computer_that_crashes_and_poses_that_are_no_numbers_are_told(tmp_path):
    """The last command holds; whether that ends well is luck, but the words say what happened, and where.

    The poses without numbers, for a second, are refused, and the motion goes on from the last good ones.
    """
    code, verdict, text = landing(tmp_path, "--fault", "crash@1", "--fault", "nan@2+1")
    assert verdict["soft"] == (code == 0), text
    assert "the flight computer has ended with code 1, at 1." in verdict["why"][0]
    assert "crashes at 1 s, as requested" in text
    assert "25 poses were refused: no numbers, or damaged" in verdict["why"]


@pytest.mark.long
@pytest.mark.socket
def test_an_unplugged_line_is_bridged(tmp_path):
    """It comes back while the vehicle holds its last speed near the ground."""
    table = tmp_path / "table.toml"
    table.write_text('[[faults]]\nkind = "unplugged"\nlink = "events"\nat_s = 2.0\nfor_s = 1.0\n')
    code, verdict, text = landing(tmp_path, "--table", table)
    assert code == 0, text
    assert any("unplugged on events from 2.0 s on" in sentence for sentence in verdict["why"])


@pytest.mark.long
@pytest.mark.socket
def test_a_landing_by_a_law_of_the_user_s(tmp_path):
    """It differs from that of the pilot's law, lands as softly, and the verdict contains its name."""
    law = f"{EXAMPLES / 'landing' / 'simple_law.py'}:Law"
    _, verdict, text = landing(tmp_path, "--guidance", law)
    assert verdict["guidance"] == law, text
    assert verdict["touched"]
    assert 0 < verdict["vertical_m_s"] < 1
    assert verdict["why"] == []
    assert verdict["beyond"] == ["horizontal_m_s"], "it stays upright, and the start has a speed along the ground"


LAW = """def law(state):
    print("x" * 100_000)  # more than a pipe holds
    {body}
    return 0.0, 0.0, 1.5
"""


@pytest.mark.long
@pytest.mark.socket
@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("while state.t_s > 1.0: pass", "did not return within 2 s, at 1.0 s and "),
        ("if state.t_s > 1: raise ValueError('late')", "raised ValueError: late, in line 3 of mine.py, at 1.0 s"),
    ],
)
def test_a_law_that_hangs_or_raises_ends_with_its_name(body, sentence, tmp_path):
    """The last command lands the vehicle, which is not good for all that."""
    law = tmp_path / "mine.py"
    law.write_text(LAW.format(body=body))
    code, verdict, text = landing(tmp_path, "--guidance", f"{law}:law")
    assert (code, verdict["soft"]) == (1, False), text[-2000:]
    assert verdict["why"][0].startswith(f"guidance {law}:law {sentence}")
    assert verdict["touched"]


def test_a_wrong_rig_is_wrong_use(tmp_path):
    table = tmp_path / "table.toml"
    table.write_text("[nothing]\nx = 1\n")
    code, verdict, text = landing(tmp_path, "--table", table)
    assert (code, verdict) == (2, None), text


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*alternative render modes.*")
def test_the_environment_passes_gymnasium_s_checker_and_its_law_is_better_than_none():
    example = runpy.run_path(str(EXAMPLES / "environment.py"))
    check_env(example["Pointing"](), skip_render_check=True)
    idle, law = (example["flown"](law) for law in (lambda counts: np.zeros(2, np.float32), example["middle_of_events"]))
    assert law > 0.7 * idle  # both are negative
    assert example["flown"](example["middle_of_events"]) == law
