"""Values of a rig's `[run]` table that a command or a call gives in its place."""

from __future__ import annotations

import dataclasses

from emulator.rig.loading import Rig

__all__ = ["with_options"]


def with_options(rig: Rig, seconds: float | None = None, seed: int | None = None, pace: str | None = None) -> Rig:
    """Return the rig with the values that are not None; raises ValueError, its message begins with the name."""
    changed = {k: v for k, v in (("seconds", seconds), ("seed", seed), ("pace", pace)) if v is not None}
    made = dataclasses.replace(rig, run=dataclasses.replace(rig.run, **changed))  # type: ignore[arg-type]
    if made.run.pace == "free" and not made.run.seconds and getattr(made.scene, "loop", False):
        raise ValueError(
            'seconds must be above 0 here, got 0: with pace "free" a recording or video that loops '
            "(scene.loop) never ends"
        )
    return made
