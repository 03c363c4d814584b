"""Compilation ahead of a run: in processes of their own, once; tests/test_wheel.py compiles all that a run needs."""

import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial
from multiprocessing import forkserver
from pathlib import Path

import pytest

import emulator
from emulator.rig.loading import load_rig, shipped_rigs
from emulator.run import kernels as preparation
from emulator.run.assembly import build_scene
from emulator.run.kernels import DECODER, EVT, Part, parts_of, prepare, uncompiled
from emulator.scene.bodies import regolith
from emulator.sensor.parameters import RadiationParameters


@pytest.fixture
def notes(tmp_path, monkeypatch):
    """Notes in an empty folder, here and in the processes that compile.

    These are forks of a server that keeps the environment of its start, so other tests get another one.
    """
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(preparation, "_folder", lambda: tmp_path)
    forkserver._forkserver._stop()
    yield tmp_path
    forkserver._forkserver._stop()


@pytest.mark.system
def test_progress_goes_to_the_end_and_tells_each_part_once(notes):
    states = []
    assert prepare([Part(f"part {k}", 1.0, partial(os.getpid)) for k in range(3)], states.append) == []
    assert sorted(states[-1].ended) == ["part 0", "part 1", "part 2"]
    assert states[-1].share == pytest.approx(1.0)
    shares = [state.share for state in states]
    assert shares == sorted(shares)


def test_what_fails_is_named_and_holds_nothing_up(notes):
    parts = [Part("bad", 1.0, partial(os.stat, "/does/not/exist")), Part("good", 1.0, partial(os.getpid))]
    assert prepare(parts) == ["bad"]


def test_parts_whose_note_is_there_are_not_cold(notes):
    part, other = Part("one", 1.0, os.getpid), Part("one", 1.0, os.getpid, "of another kind")
    preparation._note(part).touch()
    assert uncompiled([part, other]) == [other]


@pytest.mark.parametrize("name", shipped_rigs())
def test_a_rig_compiles_each_part_once(name):
    keys = [part.key for part in parts_of(load_rig(name))]
    assert len(set(keys)) == len(keys) >= 3


def test_other_numbers_of_a_sensor_need_no_other_kernels_and_other_effects_do():
    rig = load_rig("eros")

    def keys(**changes):
        sensor = dataclasses.replace(rig.camera.sensor, **changes)
        other = dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor))
        return {part.key for part in parts_of(other)}

    assert keys() == keys(threshold_on=0.31, readout=dataclasses.replace(rig.camera.sensor.readout, event_ns=300.0))
    noise = rig.camera.sensor.noise
    assert noise.rms
    assert keys() == keys(noise=dataclasses.replace(noise, rms=0.0))  # noise is a part of every pixel step
    assert keys() != keys(noise=dataclasses.replace(noise, grade="grid"))
    assert keys() != keys(radiation=RadiationParameters(hits_per_cm2_s=1.0))


def test_a_camera_on_usb_that_sends_evt3_needs_its_coder():
    assert EVT in parts_of(load_rig("stars-evk4"))
    assert EVT not in parts_of(load_rig("stars"))


@pytest.mark.system
def test_a_part_waits_for_those_that_it_needs(notes):
    first = Part("first", 1.0, partial(os.mkdir, notes / "made"))
    states = []
    second = Part("second", 9.0, partial(os.rmdir, notes / "made"), after=(first,))
    assert prepare([second, first], states.append) == []
    assert states[-1].ended == ("first", "second")
    assert prepare([second]) == ["second"]  # what it needs is done already: it does not wait


def test_nothing_is_prepared_where_it_cannot_be_stored(monkeypatch):
    monkeypatch.setattr(preparation, "_folder", lambda: None)
    assert uncompiled([DECODER]) == []


def test_a_process_of_a_pool_starts_no_others_and_compiles_what_it_uses(notes, monkeypatch):
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)
    assert uncompiled([DECODER]) == []


def test_nothing_is_prepared_where_numba_is_told_not_to_compile(notes, monkeypatch):
    assert uncompiled([DECODER]) == [DECODER]
    monkeypatch.setattr(preparation.config, "DISABLE_JIT", 1)
    assert uncompiled([DECODER]) == []


def test_the_detail_of_bodies_is_in_the_cache_for_the_run(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    rig, made = load_rig("eros"), []
    weathered = regolith.weathered
    monkeypatch.setattr(regolith, "weathered", lambda *inputs: (made.append(inputs), weathered(*inputs))[1])
    next(part for part in parts_of(rig) if part.name == "scene bodies").compile()
    with build_scene(rig):
        assert len(made) == 1


_ELSEWHERE = """
import sys
sys.path[0] = sys.argv[1]
from functools import partial
from multiprocessing import forkserver
from emulator.run.kernels import Part, prepare

text = "import emulator, pathlib; pathlib.Path('found').write_text(emulator.__file__)"
assert prepare([Part("place", 1.0, partial(exec, text))]) == []
"""


@pytest.mark.system
def test_the_program_is_compiled_and_not_the_sources_in_the_working_directory(tmp_path):
    """The README's user installs it and goes on in the source folder: its modules are not those that run."""
    (tmp_path / "emulator").mkdir()
    (tmp_path / "emulator" / "__init__.py").touch()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"}
    environment["NUMBA_CACHE_DIR"] = str(tmp_path / "notes")
    own = str(Path(emulator.__file__).parents[1])
    command = [sys.executable, "-c", _ELSEWHERE, own]
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, timeout=300)
    assert (tmp_path / "found").read_text() == emulator.__file__


@pytest.mark.system
def test_a_process_that_compiles_ends_when_the_run_is_ended():
    process = preparation._started(Part("a long one", 1.0, partial(time.sleep, 600))).process
    try:
        assert process.is_alive()
        process.terminate()
        process.join(120)
        assert process.exitcode == -signal.SIGTERM
    finally:
        process.kill()
