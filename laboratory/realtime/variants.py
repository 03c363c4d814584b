"""Variants of a rig: its scene and its sensor at two sizes, with one camera on USB/IP and a changed setting.

346 x 260 pixels are a DAVIS346, 1280 x 720 an EVK4 (the preset imx636), behind the rig's own lens and with its own
changes of the sensor. Frames, samples, triggers, faults, second cameras and lockstep are left out: all variants carry
events alone, over the same kind of link, as fast as they can. Of rigs that do not differ otherwise one is measured.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from emulator.rig.loading import Rig, find_rig, load_rig, read_rig, rig_of_table
from emulator.run.assembly import build_scene
from emulator.run.trial import runs_alone
from emulator.scene.terrain.table import TerrainParameters
from emulator.tables.toml_text import read_toml, toml_of
from emulator.threads import available_threads


@dataclass(frozen=True)
class Size:
    """A size of the sensor, and the camera model that has it."""

    name: str
    model: str


SIZES = (Size("346x260", "davis346"), Size("1280x720", "evk4"))


@dataclass(frozen=True)
class Setting:
    """Changes of a rig by table and key; `name` is for the chart."""

    name: str
    changes: Mapping[tuple[str, str], Any] = field(default_factory=dict)

    @property
    def threads_only(self) -> bool:
        """True when the events do not depend on it."""
        return set(self.changes) == {("run", "threads")}


SHIPPED = Setting("as shipped")


@dataclass(frozen=True)
class Variant:
    """A rig at a size, in a setting; `tables` are those of its rig file, without a link."""

    rig: str
    size: Size
    setting: Setting
    file: Path
    tables: Mapping[str, Any]

    @property
    def key(self) -> str:
        """Name of the variant among all of a measurement."""
        return f"{self.rig} {self.size.name} {self.setting.name}"

    def text(self, port: int) -> str:
        """Return the text of its rig file, with a camera on a port of USB/IP."""
        return toml_of(self._with_link(port))

    def loaded(self) -> Rig:
        """Return it as a rig, with a camera on any free port."""
        return rig_of_table(self._with_link(0), self.rig, self.file.parent)

    def _with_link(self, port: int) -> dict[str, Any]:
        return {**self.tables, "links": [{"kind": "usbip", "host": "127.0.0.1", "port": port}]}

    def changed(self, setting: Setting) -> Variant:
        """Return the variant in another setting."""
        tables = copy.deepcopy(dict(self.tables))
        for (table, key), value in setting.changes.items():
            tables.setdefault(table, {})[key] = value
        return Variant(self.rig, self.size, setting, self.file, tables)


def variant_of(rig: str, size: Size) -> Variant:
    """Return a rig, by path or name, at a size as it is shipped; raises RigError."""
    path = find_rig(rig)
    load_rig(rig)  # whose messages name the lines of the rig's own file
    tables = read_toml(read_rig(path))
    camera, run = tables.get("camera", {}), tables.get("run", {})
    kept = {key: camera[key] for key in ("lens", "sensor") if key in camera}
    sensor = {key: value for key, value in kept.pop("sensor", {}).items() if key not in ("width", "height")}
    left_out = ("pace", "lockstep_us", "seconds", "max_late_ms", "fifo_priority", "restart_links")
    made = {
        "scene": tables["scene"],
        "camera": {"model": size.model, "start_delay_ms": 0.0, **kept, "sensor": sensor},
        "run": {key: value for key, value in run.items() if key not in left_out},
    }
    return Variant(path.stem, size, SHIPPED, path, made)


def distinct(rigs: Iterable[str]) -> dict[str, list[str]]:
    """Return the rigs that differ in more than links and title, each with the others that are like it.

    Of those alike the first is that with a camera on USB, of the shortest name. Recordings are left out, which have no
    sensor, and so are scenes whose poses come from outside. Raises RigError.
    """
    alike: dict[str, list[str]] = {}
    for rig in rigs:
        if runs_alone(load_rig(rig)):
            same = json.dumps(variant_of(rig, SIZES[0]).tables, sort_keys=True)
            alike.setdefault(same, []).append(rig)
    groups = [sorted(group, key=_rank) for group in alike.values()]
    return {first: others for first, *others in groups}


def _rank(rig: str) -> tuple[bool, int, str]:
    has_usb = any(link.kind == "usbip" for link in load_rig(rig).links)
    return not has_usb, len(rig), rig


_STEP_SHARES = (0.5, 2.0, 4.0)
_LONGEST_STEP_US = 1_000_000
_TOLERANCE_US = 1000.0
_SAMPLES = (1, 2, 4)
_SMALLEST = (32, 24)  # pixels, of a scene that is built to read its properties


def settings_of(variant: Variant) -> Iterator[Setting]:
    """Yield the settings of a rig for the chart, where it has the choice; that as shipped first."""
    yield SHIPPED
    rig = variant.loaded()
    yield from _steps(rig)
    if rig.run.method == "hermite" and _has_rate(rig):
        yield Setting("line", {("run", "method"): "line"})
    if isinstance(rig.scene, TerrainParameters):  # bodies are drawn with exact coverage, whatever their samples
        others = (samples for samples in _SAMPLES if samples != rig.scene.samples)
        yield from (Setting(f"{n} x {n} parts", {("scene", "samples"): n}) for n in others)
    if rig.run.threads != 1 and available_threads() > 1:
        yield Setting("1 thread", {("run", "threads"): 1})


def _steps(rig: Rig) -> Iterator[Setting]:
    """Yield longer and shorter steps, and steps under control where they are fixed."""
    for share in _STEP_SHARES:
        step_us = round(rig.run.step_us * share)
        if 1 <= step_us <= _LONGEST_STEP_US:
            yield Setting(f"steps x {share:g}", {("run", "step_us"): step_us})
    if rig.run.tolerance_us:
        yield Setting("fixed steps", {("run", "tolerance_us"): 0.0})
        return
    yield Setting(f"adaptive, {_TOLERANCE_US:g} us", {("run", "tolerance_us"): _TOLERANCE_US})


def _has_rate(rig: Rig) -> bool:
    with build_scene(rig, _SMALLEST) as scene:
        return scene.has_rate
