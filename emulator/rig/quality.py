"""Rungs of accuracy against speed: `run.quality` of a rig stands for some keys, which a rig can also give alone.

    rung   run.drawing_us, in steps   camera.sensor.noise.grade
    0      1                          passages
    1      2                          passages
    2      4                          passages
    3      4                          offsets
    4      6                          offsets
    5      8                          offsets

Scenes of bodies and terrain alone have exact drawings, and so the first key. A rung changes no value that a rig gives.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import reduce
from typing import Any

from emulator.rig.tables import Run
from emulator.tables.toml_text import dotted

_STEPS = (1, 2, 4, 4, 6, 8)
_FIRST_BY_OFFSETS = 3
_DRAWING, _NOISE = ("run", "drawing_us"), ("camera", "sensor", "noise", "grade")
_DRAWN = ("bodies", "terrain")

RUNG, RUNGS = ("run", "quality"), range(len(_STEPS))
"""Path of the key, and its values, the most accurate first."""


def rung_keys(quality: int, scene_kind: str, step_us: int) -> Mapping[tuple[str, ...], int | str]:
    """Return the keys that a rung stands for, each with its value."""
    keys: dict[tuple[str, ...], int | str] = {_NOISE: "offsets" if quality >= _FIRST_BY_OFFSETS else "passages"}
    return {**keys, **({_DRAWING: _STEPS[quality] * step_us} if scene_kind in _DRAWN else {})}


def described(quality: int, rig: Any) -> dict[str, Any]:
    """Return a rung of a rig for JSON: its keys, and the parts that it leaves out in words, "" for none."""
    keys = rung_keys(quality, rig.scene.kind, rig.run.step_us)
    skipped, parts = _STEPS[quality] - 1, list[str]()
    if _DRAWING in keys and skipped:
        parts.append(f"{skipped} of {skipped + 1} exact drawings")
    if keys[_NOISE] == "offsets":
        parts.append("bursts of the noise")
    return {"quality": quality, "keys": {dotted(key): keys[key] for key in keys}, "left_out": ", ".join(parts)}


def with_rung(table: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the tables of a rig with the keys that `run.quality` stands for, where it lacks them.

    A value that is not valid, also of a key on which these depend, stays for the reader of its table to refuse.
    """
    run, scene = table.get("run"), table.get("scene")
    if not isinstance(run, dict) or not isinstance(scene, dict):
        return table
    quality, step_us = run.get("quality", -1), run.get("step_us", Run.step_us)
    if type(quality) is not int or type(step_us) is not int or quality not in RUNGS:
        return table
    table = copy.deepcopy(dict(table))
    for path, value in rung_keys(quality, str(scene.get("kind")), step_us).items():
        inner: Any = table
        for name in path[:-1]:
            inner = inner.setdefault(name, {}) if isinstance(inner, dict) else None
        if isinstance(inner, dict):
            inner.setdefault(path[-1], value)
    return table


def check_rung(rig: Any) -> None:
    """Raise ValueError where a rig has another value than its `run.quality` stands for."""
    quality = rig.run.quality
    for path, value in rung_keys(quality, rig.scene.kind, rig.run.step_us).items() if quality in RUNGS else ():
        other = reduce(getattr, path, rig)
        if other != value:
            raise ValueError(
                f"run.quality = {quality} stands for {dotted(path)} = {value!r}, and the rig gives {other!r}: leave "
                "out one of both, or take another rung"
            )
