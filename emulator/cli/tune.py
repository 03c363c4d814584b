"""`evstim tune RIG`."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from emulator.campaign.loading import path_of, with_value
from emulator.cli.checks import check_output, failures, prepared
from emulator.cli.fault import keys_of
from emulator.cli.output import (
    BAD_VERDICT,
    GOOD,
    WRONG_USE,
    Failure,
    Json,
    RigName,
    aligned,
    failing,
    print_result,
    status,
)
from emulator.rig.loading import Rig, RigError, load_rig, parse_rig, rig_of_table
from emulator.rig.quality import RUNG, RUNGS, described
from emulator.run.kernels import parts_of
from emulator.run.trial import runs_alone
from emulator.run.tuning import Ladder, Rung
from emulator.tables.toml_text import dotted, read_toml, toml_of
from emulator.tables.typed_table import TableError

_HEADS = ("rung", "leaves out", "times real time", "slowest piece", "p99 of a step", "wrong events", "memory")


def tune(
    rig: RigName,
    /,
    *,
    at_least: float = 1.3,
    out: Path | None = None,
    keys: Annotated[tuple[str, ...], Parameter(name="--set", negative="")] = (),
    json: Json = False,
) -> int:
    """Run pieces of a rig at each rung of run.quality, and choose one for this machine. Ctrl-C ends it with its table.

    Parameters
    ----------
    at_least
        Times real time that the slowest piece must reach.
    out
        Write the rig at the chosen rung to this .toml file, without comments.
    keys
        Values in place of those of the rig: --set run.step_us=40000.
    """
    if not 0 < at_least < math.inf:
        raise Failure(f"--at-least: {at_least:g} must be a number above 0", WRONG_USE)
    check_output("--out", out, ".toml")
    with failures():
        tuned = _Tuned(load_rig(rig), keys, at_least)
        is_interrupted = tuned.measure()
        if out is not None and tuned.best is not None:
            tuned.write(out)
    lines = [*tuned.lines(), *(["interrupted: not all was measured"] if is_interrupted else [])]
    print_result(json, {**tuned.as_json(), "interrupted": is_interrupted}, lines)
    return BAD_VERDICT if tuned.best is None else GOOD


class _Tuned:
    """A rig at each rung, with the keys that were set, and what was measured."""

    def __init__(self, rig: Rig, keys: tuple[str, ...], at_least: float) -> None:
        if not runs_alone(rig):
            message = "its light, poses or events come from outside, and no rung makes that faster"
            raise Failure(f"{rig.name}: {message}", WRONG_USE)
        assert rig.source is not None
        self._rig, self._at_least = rig, at_least
        self._folder = Path(rig.source.path).parent
        table: Any = read_toml(rig.source.text)
        with failing(WRONG_USE, ValueError, TableError, at="--set"):
            for key, value in keys_of(keys).items():
                if (path := path_of(key)) == RUNG:
                    raise ValueError("run.quality: all rungs are tried; leave it out")
                table = with_value(table, path, value)
        self._tables = {quality: with_value(table, RUNG, quality) for quality in RUNGS}
        self._refused: dict[int, str] = {}
        self._at = {quality: rung for quality in RUNGS if (rung := self._rig_at(quality)) is not None}
        if not self._at:
            raise Failure(f"{rig.name}: {self._refused[0]}", WRONG_USE)
        self._measured: dict[int, Rung] = {}
        self._half: Mapping[str, Any] | None = None

    def _rig_at(self, quality: int) -> Rig | None:
        """Return the rig at a rung; None where it gives another value for one of its keys. Raises Failure."""
        try:
            return rig_of_table(self._tables[quality], self._rig.name, self._folder)
        except TableError as error:
            if error.path != RUNG:
                raise Failure(f"--set {dotted(error.path)}: {error}", WRONG_USE) from error
            self._refused[quality] = str(error)
            return None

    def measure(self) -> bool:
        """Measure the rungs, and where none is fast enough half the sides; return whether that was interrupted."""
        logging.getLogger("emulator").setLevel(logging.WARNING)  # not the state of the links of each piece
        prepared([*{part.key: part for rig in self._at.values() for part in parts_of(rig)}.values()])
        try:
            status.print(f"{self._rig.name}: looking for the dearest parts of its run")
            with Ladder(next(iter(self._at.values()))) as ladder:
                for quality, rig in self._at.items():
                    if (rung := self._like(quality)) is None:
                        rung = ladder.climb(rig)
                        status.print(f"rung {quality}: {rung.slowest:.2g} times real time where it is slowest")
                    self._measured[quality] = rung
            if self.best is None:
                self._measure_half(self._at[self._nearest])
        except BaseException as error:  # numba raises SystemError from it
            if not isinstance(error.__cause__ or error, KeyboardInterrupt) or not self._measured:
                raise
            return True
        return False

    def _like(self, quality: int) -> Rung | None:
        """Return what was measured at an earlier rung with the same keys."""
        same = {
            k: dataclasses.replace(rig, run=dataclasses.replace(rig.run, quality=-1)) for k, rig in self._at.items()
        }
        return next((rung for k, rung in self._measured.items() if same[k] == same[quality]), None)

    def _measure_half(self, rig: Rig) -> None:
        width, height = (max(2, side // 2) for side in rig.camera.size)
        sensor = dataclasses.replace(rig.camera.sensor, width=width, height=height)
        half = dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor))
        status.print(f"rung {rig.run.quality} at {width}x{height}")
        with Ladder(half) as ladder:
            self._half = {"width": width, "height": height, **vars(ladder.climb(half))}

    @property
    def best(self) -> int | None:
        """The most accurate rung that is fast enough; None: there is none."""
        return next((k for k, rung in self._measured.items() if rung.slowest >= self._at_least), None)

    @property
    def _nearest(self) -> int:
        return max(self._measured, key=lambda k: self._measured[k].slowest)

    def as_json(self) -> dict[str, Any]:
        """Return the table and the choice, for programs."""
        rungs = [described(quality, self._at.get(quality, self._rig)) for quality in RUNGS]
        for k, row in enumerate(rungs):
            row |= {"refused": self._refused.get(k), "measured": self._measured.get(k)}
        choice = {"best": self.best, "half": self._half}
        return {"rig": self._rig.name, "at_least": self._at_least, "rungs": rungs, **choice}

    def lines(self) -> Iterator[str]:
        """Yield the table and the choice, for people."""
        rows = list[Sequence[str]]([_HEADS])
        for quality, rung in self._measured.items():
            words = described(quality, self._rig)["left_out"] or "nothing"
            speeds = f"{rung.median:.2f}", f"{rung.slowest:.2f}", f"{rung.p99_ms:.3g} ms"
            wrong = "-" if rung.wrong_share is None else f"{rung.wrong_share:.2%}"
            rows.append((str(quality), words, *speeds, wrong, f"{rung.memory_mib:.0f} MiB"))
        yield from aligned(rows)
        yield "wrong events: of the light alone, measured here, beside exact drawings in each step"
        yield from (f"rung {quality} not tried: {reason}" for quality, reason in self._refused.items())
        if self.best is not None:
            yield f"best: run.quality = {self.best}"
            return
        slowest = self._measured[self._nearest].slowest
        yield f"none reaches {self._at_least:g}: the nearest is rung {self._nearest} with {slowest:.2f} times real time"
        if (half := self._half) is not None:
            size = f"{half['width']}x{half['height']}"
            yield f"or, there, a sensor of {size} pixels: {half['slowest']:.2f} times real time"
        yield f"or lockstep, in step with a bus: {1 / slowest:.2g} s for a second of the stream"

    def write(self, out: Path) -> None:
        """Write the rig at the best rung; raises Failure."""
        text = toml_of(self._tables[self.best or 0])
        with failing(WRONG_USE, OSError, RigError, at=f"--out: {out}"):
            if parse_rig(text, str(out), self._rig.name) != self._at[self.best or 0]:
                raise RigError(f"the rig names files beside it: choose a file in {self._folder}")
            out.write_text(text, encoding="utf-8")
