"""The measurements of `evstim bench realtime`: one after another, each stored, so that a later call goes on.

A result is stored under the whole text of its variant, the extent of the measurement and the version of evstim: a
changed rig is measured anew. What failed is not stored. Wrong events of a setting that is ten times slower than the rig
as shipped are left out: it is no choice, and steps of microseconds would take hours.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from emulator.light import SceneError
from laboratory.accuracy.rendering import Stretch
from laboratory.bench.streams import BenchFailed
from laboratory.realtime.program import Span, Speed, measure_speed
from laboratory.realtime.variants import SHIPPED, Size, Variant, settings_of, variant_of
from laboratory.realtime.wrong_events import TRUTH, Truth, Wrong, has_truth, truth_of, wrong_events


@dataclass(frozen=True)
class Extent:
    """Length of a measured run, as shipped and in other settings, and the stretch of its wrong events.

    No stretch: those of `accuracy.rendering`.
    """

    span: Span
    other: Span
    stretch: Stretch | None


_SLOW = 0.1  # of the speed as shipped

WHOLE = Extent(Span(), Span(wall_s=5.0), None)
QUICK = Extent(Span(stream_s=2.0, wall_s=2.0), Span(stream_s=2.0, wall_s=2.0), Stretch(steps=4, samples=4, finer=4))


@dataclass(frozen=True)
class Measurement:
    """One thing to measure of a variant: its speed, or its wrong events."""

    kind: Literal["speed", "wrong"]
    variant: Variant

    @property
    def name(self) -> str:
        """Name for progress."""
        return f"{self.variant.key}: {'wrong events' if self.kind == 'wrong' else 'speed'}"


def measurements_of(rigs: Sequence[str], sizes: Sequence[Size], *, sweep: bool) -> Iterator[Measurement]:
    """Yield what there is to measure of the rigs at the sizes, as shipped or in all settings; raises RigError.

    All speeds come first, because a truth takes longer. A scene without truth has no place in the chart: it is measured
    as shipped alone.
    """
    shipped = [variant_of(rig, size) for rig in rigs for size in sizes]
    judged = [each for each in shipped if has_truth(each.loaded())]
    settings = {each.key: [each.changed(s) for s in settings_of(each)] if sweep else [each] for each in judged}
    for each in shipped:
        yield from (Measurement("speed", variant) for variant in settings.get(each.key, [each]))
    for each in judged:
        choices = (variant for variant in settings[each.key] if not variant.setting.threads_only)
        yield from (Measurement("wrong", variant) for variant in choices)


class Store:
    """Results by key, in a file to which each is appended at once; raises OSError.

    A line that a kill has cut is left out.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._results: dict[str, dict[str, Any]] = {}
        for line in path.read_text().splitlines() if path.exists() else ():
            try:
                entry = json.loads(line)
            except ValueError:
                continue
            self._results[entry["key"]] = entry["result"]

    @property
    def truths(self) -> Path:
        """Folder of the truths."""
        return self._path.parent / "truths"

    def get(self, key: str) -> dict[str, Any] | None:
        """Return a result; None where there is none yet."""
        return self._results.get(key)

    def put(self, key: str, name: str, result: dict[str, Any]) -> None:
        """Store a result; `name` is for readers of the file."""
        self._results[key] = result
        with self._path.open("a") as file:
            file.write(json.dumps({"key": key, "name": name, "result": result}) + "\n")


@dataclass
class Measurements:
    """Measurements and their results.

    Attributes
    ----------
    failures : reasons by name of a measurement.
    """

    wanted: Sequence[Measurement]
    store: Store
    extent: Extent = WHOLE
    failures: dict[str, str] = field(default_factory=dict)
    _truth: tuple[str, Truth] | None = None

    def run(self) -> Iterator[Measurement]:
        """Measure what the store lacks; yield each before it is measured."""
        for one in self.wanted:
            yield one
            if self._result(one) is None and not (one.kind == "wrong" and self._is_slow(one.variant)):
                self._measure(one)

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each variant that has a speed; values that were not measured are None."""
        wrong = {one.variant.key: self._result(one) for one in self.wanted if one.kind == "wrong"}
        speeds = [(one.variant, self._result(one)) for one in self.wanted if one.kind == "speed"]
        return [_row(variant, speed, _wrong_of(variant, wrong)) for variant, speed in speeds if speed is not None]

    def _measure(self, one: Measurement) -> None:
        try:
            result = self._measured(one)
        except (BenchFailed, SceneError) as error:
            self.failures[one.name] = str(error)
        else:
            self.store.put(self._key(one), one.name, dataclasses.asdict(result))

    def _is_slow(self, variant: Variant) -> bool:
        factors = {one.variant.key: result["factor"] for one in self.wanted if (result := self._speed(one))}
        own, shipped = (factors.get(one.key) for one in (variant, variant.changed(SHIPPED)))
        return own is not None and shipped is not None and own < _SLOW * shipped

    def _speed(self, one: Measurement) -> dict[str, Any] | None:
        return self._result(one) if one.kind == "speed" else None

    def _measured(self, one: Measurement) -> Speed | Wrong:
        is_speed = one.kind == "speed"
        return measure_speed(one.variant, self._span(one.variant)) if is_speed else self._wrong(one.variant)

    def _span(self, variant: Variant) -> Span:
        return self.extent.span if variant.setting is SHIPPED else self.extent.other

    def _wrong(self, variant: Variant) -> Wrong:
        """Measure wrong events; the truth of one rig and size is held at a time, for all its settings."""
        place = f"{variant.rig} {variant.size.name}"
        if self._truth is None or self._truth[0] != place:
            self._truth = place, self._truth_of(variant)
        return wrong_events(variant, self._truth[1])

    def _truth_of(self, variant: Variant) -> Truth:
        return truth_of(variant_of(str(variant.file), variant.size), self.extent.stretch, self.store.truths)

    def _result(self, one: Measurement) -> dict[str, Any] | None:
        return self.store.get(self._key(one))

    def _key(self, one: Measurement) -> str:
        extent = self._span(one.variant) if one.kind == "speed" else (TRUTH, self.extent.stretch)
        text = f"{version('evstim')} {one.kind} {extent} {one.variant.size.name}\n{one.variant.text(0)}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _wrong_of(variant: Variant, found: dict[str, dict[str, Any] | None]) -> dict[str, Any]:
    """Return the wrong events of a variant; those as shipped where the setting does not change events."""
    same = variant.changed(SHIPPED) if variant.setting.threads_only else variant
    return found.get(same.key) or dict.fromkeys(field.name for field in dataclasses.fields(Wrong))


def _row(variant: Variant, speed: dict[str, Any], wrong: dict[str, Any]) -> dict[str, Any]:
    total = None if wrong["false"] is None else wrong["false"] + wrong["missed"]
    names = {"rig": variant.rig, "size": variant.size.name, "setting": variant.setting.name}
    judged = {key: value for key, value in wrong.items() if key != "events"}
    return {**names, **speed, **judged, "wrong": total, "true_events": wrong["events"]}
