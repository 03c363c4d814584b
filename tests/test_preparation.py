"""The order and the processes in which kernels are compiled ahead of a run; nothing is compiled here."""

import os
import signal
import time
from functools import partial
from types import SimpleNamespace

import pytest

from emulator.rig.loading import load_rig
from emulator.run import kernels
from emulator.run.kernels import parts_of, prepare


@pytest.fixture
def started(monkeypatch):
    """Names of the parts in the order of their start; one core, and each process ends at once."""
    names = []

    def start(part):
        names.append(part.name)
        return SimpleNamespace(part=part, began_s=0.0, process=ended)

    ended = SimpleNamespace(sentinel=0, is_alive=lambda: False, exitcode=0, terminate=lambda: None)
    monkeypatch.setattr(kernels, "_started", start)
    monkeypatch.setattr(kernels, "wait", lambda sentinels, timeout: None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0})
    return names


def test_long_parts_start_first_and_a_part_after_those_that_it_needs(started):
    assert prepare(parts_of(load_rig("eros"))) == []
    of_pixels = ["pixel candidates", "pixel blocks", "pixel step"]
    assert started == ["pixel noise", "scene bodies", *of_pixels, "read-out and effects"]


@pytest.mark.system
def test_a_process_that_compiles_ends_when_the_run_is_ended():
    process = kernels._started(kernels.Part("a long one", 1.0, partial(time.sleep, 600))).process
    try:
        assert process.is_alive()
        process.terminate()
        process.join(120)
        assert process.exitcode == -signal.SIGTERM
    finally:
        process.kill()


@pytest.mark.system
def test_a_process_that_compiles_starts_with_numba_imported(tmp_path):
    code = f"import pathlib, sys; pathlib.Path({str(tmp_path / 'modules')!r}).write_text(' '.join(sys.modules))"
    kernels._started(kernels.Part("modules", 1.0, partial(exec, code))).process.join()
    assert {"numba", "emulator.run.kernels"} < set((tmp_path / "modules").read_text().split())
