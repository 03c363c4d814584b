"""The wheel stands alone: rigs and shapes are in it, and it runs outside the checkout.

Its fresh environment lacks all optional packages: no shipped rig needs one. It is the one place where kernels are
compiled anew, once for all tests: at a first run. Each process in it notes the kernels that it compiles.

Then the commands of the first pages are typed in this environment, in a copy of the source folder around it.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import pytest

from emulator.rig.loading import load_rig, shipped_rigs
from emulator.run.machine import needs_of
from tests.typed_commands import Terminal, commands_of, lines_of, pattern_of, without_comment

ROOT = Path(__file__).parent.parent

NOTES = """
import json, os
from numba.core import event

class Notes(event.Listener):
    def on_start(self, started):
        function = started.data["dispatcher"].py_func
        note = [os.getpid(), f"{function.__module__}.{function.__qualname__}", str(started.data["args"])]
        with open(os.environ["COMPILATIONS"], "a") as file:
            file.write(json.dumps(note) + "\\n")
    def on_end(self, ended):
        pass

event.register("numba:compile", Notes())
"""

RUN = """
import dataclasses, hashlib, json, os
import evstim
from emulator.rig.loading import load_rig
from emulator.run.kernels import CODER, DECODER, EVT, parts_of, prepare, uncompiled

if __name__ == "__main__":
    rig, coders = dataclasses.replace(load_rig("eros"), links=()), [CODER, DECODER, EVT]
    failed = prepare(uncompiled(coders))
    digest, count = hashlib.sha256(), 0
    with evstim.run(rig, seconds=0.2, pace="free") as run:
        for events in run:
            digest.update(events.tobytes())
            count += len(events)
    for part in coders:
        part.compile()
    cold = [part.name for part in uncompiled([*parts_of(rig), *coders])]
    printed = {"digest": digest.hexdigest(), "events": count, "failed": failed, "cold": cold, "process": os.getpid()}
    print(json.dumps(printed))
"""

PIXELS = """
import dataclasses, hashlib
import numpy as np
import evstim
from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS

row, column = np.mgrid[:64, :96]
rng = np.random.default_rng(1)
size, phase, rate = rng.uniform(0.1, 1000, row.shape), rng.uniform(0, 6, row.shape), rng.uniform(10, 2000, row.shape)

def light(t_s):
    return (size * (1.05 + np.sin(phase + rate * t_s))).astype(np.float32)

pixels = PixelArray(dataclasses.replace(PRESETS["davis346"], width=96, height=64), 1)
sensor = evstim.Sensor("davis346", width=96, height=64, seed=1)
pixels.reset(LightFrame(0, light(0)))
sensor.reset(light(0))
digest = hashlib.sha256()
for k in range(1, 60):
    rate_of_light = (size * rate * np.cos(phase + rate * k * 1e-3)).astype(np.float32)
    digest.update(pixels.step(LightFrame(1_000_000 * k, light(k * 1e-3), rate_of_light)).t_ns)
    digest.update(sensor.expose(light(k * 1e-3), 1_000_000 * k).tobytes())
print(digest.hexdigest())
"""

MANY_RIGS = """
import json, sys
from emulator.cli import main

for rig in json.loads(sys.argv[1]):
    sys.argv[1:] = ["run", rig, "--seconds", "0.02", "--pace", "free", "--json"]
    try:
        main()
    except SystemExit as ended:
        print(json.dumps([rig, ended.code]), flush=True)
"""


def pip(*arguments):
    command = [sys.executable, "-m", "pip", *map(str, arguments), "--quiet", "--disable-pip-version-check"]
    subprocess.run(command, check=True, timeout=600, stderr=subprocess.PIPE)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", ROOT, "--no-deps", "--wheel-dir", folder)
    (path,) = folder.glob("evstim-*.whl")
    return path


@pytest.mark.system
def test_what_is_in_the_wheel(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for path in (ROOT / "emulator/scene/bodies/shapes").iterdir():
        assert str(path.relative_to(ROOT)) in names
    assert {f"evstim/rigs/{path.name}" for path in (ROOT / "rigs").glob("*.toml")} < names
    assert "evstim/py.typed" in names
    rooms = {name.partition("/")[0] for name in names if ".dist-info" not in name}
    assert rooms == {"evstim", "emulator", "transports", "firmware_protocol", "laboratory"}


@pytest.mark.long
@pytest.mark.system
def test_a_package_index_takes_the_wheel_and_the_sdist_which_makes_the_same_wheel(wheel, tmp_path):
    hatchling = [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path]
    subprocess.run(hatchling, cwd=ROOT, check=True, capture_output=True)
    (sdist,) = tmp_path.glob("evstim-*.tar.gz")
    checked = subprocess.run([sys.executable, "-m", "twine", "check", "--strict", wheel, sdist], capture_output=True)
    assert checked.returncode == 0, checked.stdout
    pip("wheel", sdist, "--no-deps", "--wheel-dir", tmp_path)
    (again,) = tmp_path.glob("evstim-*.whl")
    with zipfile.ZipFile(wheel) as first, zipfile.ZipFile(again) as second:
        files = [{entry.filename: entry.CRC for entry in archive.infolist()} for archive in (first, second)]
    assert files[0] == files[1]


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The Python of a fresh environment with pip, the wheel and its base dependencies, and nothing else."""
    folder = tmp_path_factory.mktemp("evstim") / ".venv"
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    pip("--python", folder, "install", "--no-compile", wheel)
    return folder / "bin" / "python"


@pytest.fixture(scope="module")
def run_installed(installed, tmp_path_factory):
    """Run a program in the fresh environment; return its end and notes: process, kernel and types of compilations."""
    folder = tmp_path_factory.mktemp("programs")
    (folder / "notes").mkdir()
    (folder / "notes" / "sitecustomize.py").write_text(NOTES)
    settings = {"PYTHONPATH": str(folder / "notes"), "NUMBA_CACHE_DIR": str(folder / "kernels")}
    settings["COMPILATIONS"] = str(folder / "compilations")

    def run(program, *arguments):
        script, compilations = folder / "program.py", folder / "compilations"
        script.write_text(program)
        compilations.write_text("")
        done = subprocess.run(
            [installed, script, *arguments],
            cwd=folder, env=os.environ | settings, capture_output=True, text=True, timeout=1700,
        )  # fmt: skip
        return done, [json.loads(line) for line in compilations.read_text().splitlines()]

    run.kernels = folder / "kernels"
    return run


@pytest.fixture(scope="module")
def runs(run_installed):
    """Two runs of one rig: all that they print, and what they compile."""
    ends = []
    for _ in range(2):
        done, compiled = run_installed(RUN)
        assert done.returncode == 0, done.stderr
        printed = json.loads(done.stdout.splitlines()[-1])
        ends.append(SimpleNamespace(printed=printed, progress=done.stderr, compiled=compiled))
    return ends


@pytest.mark.anew
@pytest.mark.timeout(3600)
def test_the_first_run_has_the_events_of_the_next(runs):
    first, again = runs
    assert "compiling" in first.progress
    assert "compiling" not in again.progress
    assert first.printed["events"] == again.printed["events"] > 1000
    assert first.printed["digest"] == again.printed["digest"]


@pytest.mark.anew
@pytest.mark.timeout(3600)
def test_after_the_preparation_a_run_compiles_nothing(runs):
    first, again = runs
    for one in runs:
        assert (one.printed["failed"], one.printed["cold"]) == ([], [])
    assert [note for note in first.compiled if note[0] == first.printed["process"]] == []
    assert again.compiled == []


@pytest.mark.anew
@pytest.mark.timeout(3600)
def test_no_kernel_is_compiled_for_two_sets_of_types(runs):
    types = defaultdict(set)
    for _, kernel, arguments in runs[0].compiled:
        if kernel.startswith(("emulator.", "firmware_protocol.", "laboratory.")):
            types[kernel].add(re.sub(r"Literal\[int\]\(\d+\)", "int64", arguments))  # constants are on purpose
    assert len(types) > 100
    most = {kernel: 2 if ".parts_writer." in kernel else 1 for kernel in types}  # it makes those of EVT2 and of EVT3
    assert {kernel: found for kernel, found in types.items() if len(found) > most[kernel]} == {}


@pytest.mark.anew
@pytest.mark.timeout(3600)
def test_the_process_that_compiles_has_the_event_times_of_the_next_one(run_installed, runs):
    """The first process has parts of the pixel step from disk, and compiles what calls them."""
    for index in run_installed.kernels.rglob("step.advance-*.nbi"):
        index.unlink()
    (first, compiled), (again, compiled_again) = run_installed(PIXELS), run_installed(PIXELS)
    assert first.returncode == again.returncode == 0, first.stderr + again.stderr
    assert "emulator.sensor.pixels.step.advance" in {kernel for _, kernel, _ in compiled}
    assert compiled_again == []
    assert first.stdout == again.stdout != ""


def covering_rigs():
    """Return shipped rigs that have a scene, a camera or a kind of link that none of those before has."""
    seen, rigs = set(), []
    for name in shipped_rigs():
        rig = load_rig(name)
        own = {f"scene {rig.scene.kind}", f"camera {rig.camera.model}", *(f"link {link.kind}" for link in rig.links)}
        if own - seen:
            seen |= own
            rigs.append(name)
    return rigs


RIGS = covering_rigs()


@pytest.fixture(scope="module")
def ends(run_installed, runs):
    """Exit code and JSON of each of these rigs, run after one another by one process."""
    done, _ = run_installed(MANY_RIGS, json.dumps(RIGS))
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith(("{", "["))]
    assert len(lines) == 2 * len(RIGS), done.stderr
    return {rig: (code, told, done.stderr) for told, (rig, code) in zip(lines[::2], lines[1::2], strict=True)}


@pytest.mark.long
@pytest.mark.anew
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("rig", RIGS)
def test_a_shipped_rig_runs_from_an_installed_wheel(ends, rig):
    code, told, stderr = ends[rig]
    if missing := [need.look().name for need in needs_of(load_rig(rig)) if need.by == "run"]:
        assert (code, missing[0] in told["error"], "pip install '.[" in told["error"]) == (3, True, True), stderr
        return
    assert code == 0, stderr
    assert told["balanced"] is True


@pytest.mark.anew
def test_a_fresh_environment_has_no_optional_package(installed):
    code = "import importlib.util as u; print([n for n in ('PIL', 'matplotlib', 'faery', 'av') if u.find_spec(n)])"
    done = subprocess.run([installed, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


PAGES = ("README.md", "docs/index.md", "docs/tutorial.md")
LEFT_OUT = {  # commands that are not typed here, and the reason
    r"make (demo|smoke|test)": "they install all packages; `make test` runs this test and tests/test_smoke.py",
    r"(sudo )?usbip|sudo modprobe": "root and a kernel module; tests/guest attaches cameras in a machine of its own",
    r"evstim demo": "seconds to minutes of real time each; tests/emulator/cli, tests/guest and tests/examples run them",
    r"evstim campaign": "64 runs; tests/emulator/campaign and tests/examples run campaigns",
    r"evstim run stars-ros2": "its package is large; tests/transports/ros2 runs it",
    r"evstim vizard": "it waits for a simulation; tests/examples/test_basilisk.py has one",
}
RUNS_ON = {  # commands that run until Ctrl-C, and what they print when they work
    r"evstim run (?!.*--seconds)": r"[1-9]\d* frames",
    r"evstim listen (?!.*--seconds)": r"[1-9]\d* events",
    r"python (first_try|centroid)\.py|\./centroid": r"x [\d.]+, y [\d.]+",
}
IS_READER = re.compile(r"evstim (listen|fault)|python |\./centroid|C=|cc |stty ")  # they work beside a camera
LATE = re.compile(r"NOT GOOD: \d of \d+ rules broken: ((in real time|steps in time)(, )?)+\s")


class Desk:
    """Terminals in the source folder: a command is typed into the first one in which no program runs.

    A camera runs until the page goes on with what is no reader of it, and a reader until it goes on with what is no
    fault; then Ctrl-C is pressed. Commands in a comment are typed as well: "then, in a second terminal: ..." after the
    command, and "pip install ...: ..." before it.
    """

    def __init__(self, folder, environment):
        self.environment = environment
        self.terminals = [Terminal(folder, environment)]
        self.running, self.typed = {}, []

    def follow(self, line):
        command, comment = without_comment(line)
        if any(re.match(left, command) for left in LEFT_OUT):
            return
        if (before := re.match(r"pip install [^\s:]+", comment)) and before[0] not in self.typed:
            self.follow(before[0])
        self.end_before(command)
        self.typed.append(command)
        terminal = next((one for one in self.terminals if one.is_idle), None) or self.open()
        works = next((pattern for name, pattern in RUNS_ON.items() if re.match(name, command)), None)
        if works is None:
            assert terminal.run(command) == 0, f"{command}: {terminal.output}"
        else:
            self.running[terminal] = command
            terminal.type(command)
            terminal.wait_for(works)
        if after := re.search(r"\bthen\b[^:]*: ([^`]+)", comment):
            self.follow(after[1])

    def shows(self, pattern):
        """Return whether a terminal shows a pattern, or will soon."""
        return any(terminal.has_printed(pattern, within_s) for within_s in (0, 20) for terminal in self.terminals)

    def open(self):
        self.terminals.append(Terminal(self.terminals[0].folder, self.environment))
        return self.terminals[-1]

    def end_before(self, command):
        for terminal, other in reversed(list(self.running.items())):  # readers first
            is_camera = other.startswith("evstim run")
            if not (IS_READER.match(command) if is_camera else command.startswith("evstim fault")):
                code = terminal.interrupt()
                assert not is_camera or code == 0 or LATE.search(terminal.output), f"{other}: {terminal.output}"
                del self.running[terminal]


@pytest.fixture(scope="module")
def checkout(installed, tmp_path_factory):
    """A copy of the source folder around the fresh environment, which has the kernels that this folder has.

    Its folder, and the environment variables of its reader.
    """
    folder = installed.parents[2]
    ignored = [line.strip("/") for line in (ROOT / ".gitignore").read_text().splitlines()]
    shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(".git", *ignored), dirs_exist_ok=True)
    (packages,) = folder.glob(".venv/lib/python*/site-packages")
    for file in ROOT.glob("*/**/__pycache__/*"):
        if file.suffix in (".nbi", ".nbc", ".compiled"):
            (packages / file.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, packages / file.relative_to(ROOT))
    ours = re.compile("PYTHON|PYTEST|NUMBA|VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if not ours.match(name)}
    environment["XDG_RUNTIME_DIR"] = str(tmp_path_factory.mktemp("runtime"))  # no run of others is a run of this reader
    python = os.path.dirname(os.path.realpath(sys.executable))
    environment["PATH"] = os.pathsep.join([str(installed.parent), python, os.environ["PATH"]])
    return folder, environment


@pytest.fixture
def desk(checkout):
    desk = Desk(*checkout)
    yield desk
    for terminal in desk.terminals:
        terminal.close()


@pytest.mark.anew
@pytest.mark.socket
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_work_as_printed(desk, page):
    """What a page shows as printed comes before its next command: a program must not be ended before."""
    for line, is_printed in lines_of((ROOT / page).read_text(encoding="utf-8")):
        if is_printed:
            assert desk.shows(pattern_of(line)), line
        else:
            desk.follow(line)
    desk.end_before("the end")


def test_what_is_left_out_is_still_on_a_page():
    lines = [line for page in PAGES for line in commands_of((ROOT / page).read_text())]
    assert [left for left in [*LEFT_OUT, *RUNS_ON] if not any(re.search(left, line) for line in lines)] == []
