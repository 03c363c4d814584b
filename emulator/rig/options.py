"""Values of a rig's `[run]` table that a command or a call gives in its place."""

from __future__ import annotations

import dataclasses

from emulator.rig.loading import Rig

__all__ = ["with_options"]


def with_options(rig: Rig, seconds: float | None = None, seed: int | None = None, pace: str | None = None) -> Rig:
    """Return the rig with the values that are not None; raises ValueError, its message begins with the name."""
    changed = {k: v for k, v in (("seconds", seconds), ("seed", seed), ("pace", pace)) if v is not None}
    return dataclasses.replace(rig, run=dataclasses.replace(rig.run, **changed))  # type: ignore[arg-type]
