"""Compilation of kernels ahead of a run, in parallel processes.

numba keeps on disk what it has compiled, so this is needed once, and again after a change of the program. A file beside
the kernels notes that a part is done. Without that file everything works too, and is compiled at its first use.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from numba import config

from emulator.run.kernels import Part
from firmware_protocol.numba_cache import cache_folder, checksum_of

__all__ = ["Preparation", "cold", "prepare"]

_TICK_S = 0.2
_MOST_OF_A_PART = 0.95  # what a part that takes longer than expected counts for


@dataclass(frozen=True)
class Preparation:
    """State of a preparation: parts that have ended, and the share of the work that is done, 0 to 1."""

    ended: tuple[str, ...]
    share: float


@dataclass(frozen=True)
class _Running:
    part: Part
    process: BaseProcess
    began_s: float


def cold(parts: Sequence[Part]) -> list[Part]:
    """Return the parts that have not been compiled on this machine yet; none with NUMBA_DISABLE_JIT."""
    if getattr(config, "DISABLE_JIT", 0):
        return []
    return [part for part in parts if not _note(part).exists()]


def prepare(parts: Sequence[Part], on_state: Callable[[Preparation], None] = lambda _: None) -> list[str]:
    """Compile the parts, as many at a time as there are cores; return the names of those that failed.

    The longest come first, but none before those that it needs.
    """
    waiting, running = sorted(parts, key=lambda part: -part.seconds), list[_Running]()
    ended: list[str] = []
    failed: list[str] = []
    try:
        while waiting or running:
            busy = {part.key for part in (*waiting, *(one.part for one in running))}
            for part in [part for part in waiting if not busy & {needed.key for needed in part.after}]:
                if len(running) < len(os.sched_getaffinity(0)):
                    waiting.remove(part)
                    running.append(_started(part))
            wait([one.process.sentinel for one in running], _TICK_S)
            gone = [one for one in running if not one.process.is_alive()]
            running = [one for one in running if one not in gone]
            ended += [one.part.name for one in gone]
            failed += [one.part.name for one in gone if one.process.exitcode]
            on_state(Preparation(tuple(ended), _share(parts, ended, running)))
    finally:
        for one in running:
            one.process.terminate()
    return failed


def _share(parts: Sequence[Part], ended: Sequence[str], running: Sequence[_Running]) -> float:
    """Return the share of the work that is done; a part in work counts by its time."""
    done_s = sum(part.seconds for part in parts if part.name in ended)
    now_s = time.monotonic()
    begun_s = sum(min(now_s - one.began_s, _MOST_OF_A_PART * one.part.seconds) for one in running)
    return (done_s + begun_s) / sum(part.seconds for part in parts)


def _started(part: Part) -> _Running:
    process = multiprocessing.get_context("spawn").Process(target=_compile, args=(part,), daemon=True)
    process.start()
    return _Running(part, process, time.monotonic())


def _compile(part: Part) -> None:
    """Compile a part and note that it is done."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever waits for this process ends it
    part.compile()
    note = _note(part)
    with suppress(OSError):  # then numba has nowhere to write either
        note.parent.mkdir(parents=True, exist_ok=True)
        note.touch()


def _note(part: Part) -> Path:
    return _folder() / f"evstim-{_version()}-{part.key}.compiled"


@cache
def _folder() -> Path:
    from firmware_protocol.telemetry.reading import read_block

    return cache_folder(read_block)


@cache
def _version() -> str:
    """Return the checksum of what compiled code depends on: our sources, numba's version, and the processor."""
    import llvmlite.binding
    import numba

    root = Path(__file__).parents[2]
    sources = [checksum_of(root / folder) for folder in ("emulator", "firmware_protocol")]
    words = f"{sources} {numba.__version__} {llvmlite.binding.get_host_cpu_name()}"
    return f"{zlib.crc32(words.encode()):08x}"
