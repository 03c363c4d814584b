"""Trial of a rig on this machine: some steps of its scene and its sensor, without its links and readings.

A run is not changed by a trial before it: light depends on the time alone, and the trial has a sensor of its own. A
second camera counts as much as the first.
"""

from __future__ import annotations

import dataclasses
import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emulator.light import Scene, SceneError, SceneFrames
from emulator.rig.loading import Rig, shipped_rigs
from emulator.run.assembly import build_frames, build_sensor, is_drawn_here
from emulator.sensor.sensor import EventSource
from firmware_protocol.events import Floats

if TYPE_CHECKING:
    from emulator.plan.plan import Plan

INSTANTS = 4
"""Instants of a trial that is not in the way of a run."""
_LONG_S = 0.25


@dataclass(frozen=True)
class Trial:
    """Wall time of the light frame and of the pixels of a step of `step_s`, s, the means."""

    step_s: float
    drawing_s: float
    pixels_s: float

    @property
    def factor(self) -> float:
        """Stream seconds for a wall second."""
        return self.step_s / (self.drawing_s + self.pixels_s)

    @property
    def line(self) -> str:
        """The speed as one sentence."""
        total_s = self.drawing_s + self.pixels_s
        return (
            f"{self.factor:.2g} times real time in a trial without links: a step of {self.step_s * 1e6:.0f} us takes "
            f"{total_s * 1e3:.3g} ms, drawing {self.drawing_s / total_s:.0%}, pixels {self.pixels_s / total_s:.0%}"
        )

    def verdict(self, rig: Rig) -> str:
        """Return whether a rig runs in real time, with the command that would help where it does not."""
        if self.factor > 1:
            return f"runs in real time on this machine: {self.line}"
        path = None if rig.source is None else Path(rig.source.path)
        name = rig.name if path is None or path == shipped_rigs().get(rig.name) else str(path)
        remedy = f"`evstim tune {shlex.quote(name)}` shows what would"
        return f"does NOT run in real time on this machine: {self.line}; {remedy}"

    def as_json(self) -> dict[str, float]:
        """Return the object `speed` of `evstim plan --json`, and `expected` of `evstim doctor --json`."""
        return {"times_real_time": self.factor, **dataclasses.asdict(self)}


def runs_alone(rig: Rig) -> bool:
    """Return whether neither light nor poses of a rig come from another program, nor its events from a recording."""
    paths = [getattr(rig.scene, "camera", None), *(body.path for body in getattr(rig.scene, "bodies", ()))]
    is_driven = any(getattr(path, "kind", "") in ("live", "basilisk") for path in paths)
    return is_drawn_here(rig) and rig.scene.kind != "ros2" and not is_driven


def step_costs(frames: SceneFrames, source: EventSource, t_ns: int, step_ns: int, wall_s: float) -> list[Floats]:
    """Return the wall time of light frame and pixels, (2,) s, of each step from `t_ns` on that begins in `wall_s`.

    There is at least one step; raises SceneError where it cannot be drawn.
    """
    source.reset(frames.draw(t_ns))
    costs_s, end_s = list[Floats](), time.perf_counter() + wall_s
    while not costs_s or time.perf_counter() < end_s:
        t_ns += step_ns
        begun_s = time.perf_counter()
        try:
            frame = frames.draw(t_ns)
        except SceneError:  # a scene may end before the trial
            if not costs_s:
                raise
            break
        drawn_s = time.perf_counter()
        source.expose(frame)
        costs_s.append(np.array([drawn_s - begun_s, time.perf_counter() - drawn_s]))
    return costs_s


def trial(rig: Rig, scene: Scene, plan: Plan | None = None, instants: int = 1) -> Trial:
    """Make steps for some time, `_LONG_S` in all, from each of some instants spread over the run.

    Steps and sensor are those of `plan`, or without one of the rig. The first step after an instant is not counted,
    unless it is the only one. Raises SceneError where there is none.
    """
    source = build_sensor(rig, rig.camera.sensor if plan is None else plan.sensor)
    source.warm_up()
    frames, costs_s = build_frames(rig, scene), list[Floats]()
    step_ns = round((rig.run.step_us if plan is None else plan.steps.step_us) * 1000)
    for k in range(instants):
        t_ns = round(k / instants * (rig.run.seconds or 10.0) * 1e9)
        here_s = step_costs(frames, source, t_ns, step_ns, _LONG_S / instants)
        costs_s += here_s[1:] or here_s
    cameras = 1 if rig.second_camera is None else 2
    return Trial(step_ns * 1e-9, *(cameras * float(part_s) for part_s in np.mean(costs_s, axis=0)))
