"""Measurement of a rig's speed on this machine, relative to real time."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from emulator.plan.plan import make_plan
from emulator.plan.scene_probe import probe
from emulator.rig.kinds import SCENES
from emulator.rig.loading import Rig
from emulator.run.assembly import build_scene, build_session, schedule
from emulator.run.expected_speed import ExpectedSpeed, expected_speed
from emulator.run.outcome import RunStatus
from transports.link.pacing import MonotonicClock

_STREAM_S, _WALL_S = 2.0, 10.0


@dataclass(frozen=True)
class RealTimeSpeed:
    """Speed of a rig on this machine.

    Attributes
    ----------
    times_real_time
        Stream seconds for a second of this machine, scene and sensor without links.
    stream_s
        Stream time that was computed for this.
    planned_load
        Cores that the plan expects the whole run to keep busy; None for a recording, which has no plan.
    expected
        Speed expected from a probe over the whole run; None for a recording.
    """

    times_real_time: float
    stream_s: float
    planned_load: float | None
    expected: ExpectedSpeed | None = None

    @property
    def good(self) -> bool:
        """Return whether the rig runs in real time here."""
        return self.times_real_time > 1 and (self.planned_load is None or self.planned_load < 1)


def keeping_up(rig: Rig) -> RealTimeSpeed:
    """Compute up to two seconds of a rig's stream without pacing, for at most ten seconds."""
    with build_scene(rig) as scene:
        load, expected = None, None
        if not SCENES[rig.scene.kind].events:
            step_ns = rig.run.step_us * 1000
            made = make_plan(rig, probe(scene, rig.camera.sensor, step_ns, rig.run.seconds or 10.0))
            load, expected = made.load.total, expected_speed(made, scene)
        session = build_session(rig, scene, [], MonotonicClock())

        def follow(now: RunStatus) -> None:
            if now.wall_seconds > _WALL_S:
                session.stop()

        stream_s = min(_STREAM_S, rig.run.seconds or _STREAM_S)
        free = dataclasses.replace(schedule(rig), duration_ns=round(stream_s * 1e9), paced=False, lockstep_ns=0)
        result = session.run(free, follow)
    return RealTimeSpeed(result.sim_seconds / result.wall_seconds, result.sim_seconds, load, expected)
