"""Values of a rig's `[run]` table that a command or a call gives in its place."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Mapping
from typing import Any, get_args

from emulator.rig.loading import Rig
from emulator.rig.tables import Run
from emulator.tables.typed_table import field_types

__all__ = ["with_options"]

_PACES = get_args(field_types(Run)["pace"])


def with_options(rig: Rig, seconds: float | None = None, seed: int | None = None, pace: str | None = None) -> Rig:
    """Return the rig with the values that are not None; raises ValueError, its message begins with the name."""
    given = {"seconds": seconds, "seed": seed, "pace": pace}
    changed = {name: _converted(name, value) for name, value in given.items() if value is not None}
    made = dataclasses.replace(rig, run=dataclasses.replace(rig.run, **changed))
    if made.run.pace == "free" and not made.run.seconds and getattr(made.scene, "loop", False):
        raise ValueError(
            'seconds must be above 0 here, got 0: with pace "free" a recording or video that loops '
            "(scene.loop) never ends"
        )
    return made


def _converted(name: str, value: Any) -> Any:
    """Return a value as the table has it; raises ValueError where it is of another type."""
    convert, wanted = _TYPES[name]
    try:
        return convert(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be {wanted}, got {value!r}") from None


def _number(value: Any) -> float:
    if isinstance(value, str):
        raise TypeError
    return float(value)


def _pace(value: Any) -> str:
    if value not in _PACES:
        raise ValueError
    return str(value)


_TYPES: Mapping[str, tuple[Callable[[Any], Any], str]] = {
    "seconds": (_number, "a number of seconds, 0 (until Ctrl-C) to 3.2e7"),
    "seed": (operator.index, "a whole number, 0 to 2^63 - 1"),
    "pace": (_pace, " or ".join(f'"{pace}"' for pace in _PACES)),
}
