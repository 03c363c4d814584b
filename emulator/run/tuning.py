"""Ladder of a rig on this machine: pieces of its own run at each rung of `run.quality`, where a step costs most.

    sweep   cost of a step with exact drawings at instants spread over the run          -> the dearest instants
    speed   a session in free pace that jumps from one of these to the next; a loopback stands for each link, whose
            host reads and decodes all; frames and inertial samples are left out. A jump changes all pixels: the steps
            that follow it at once do not count
    events  those of the light alone, without leak and noise, beside those of exact drawings in the same steps

Wrong events are those that must be deleted or inserted in the sequences of polarities of the pixels, over all events.
"""

from __future__ import annotations

import ctypes
import dataclasses
import gc
import math
import resource
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emulator.light import Light, OtherLight, PixelLight, Scene, SceneError
from emulator.rig.kinds import LINKS
from emulator.rig.loading import Rig
from emulator.run.assembly import build_frames, build_scene, build_sensor, build_session, drawn_seldom, link_setups
from emulator.run.assembly import schedule as schedule_of
from emulator.run.link_process import LinkFailed
from emulator.run.trial import step_costs
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Events, Floats
from transports import Closing
from transports.link.pacing import MonotonicClock
from transports.registry import imported

_UNLIMITED_S = 180.0  # of a run without end
_GRID = 24  # steps: every rung has drawings there
_SWEEP, _LEAST_SWEEP = 16, 4  # instants: at most, and also where that takes long
_SWEEP_S, _DEAREST = 4.0, 3
_PIECE_S, _LONGEST = 0.7, 2  # of wall time, and times as much to come to the next drawing
_RUNG_S, _NOT_COUNTED = 3.0, 2  # after which no further piece begins; steps after a jump
_LIGHT_S, _LIGHT_STEPS = 2.0, 16  # fewer steps where exact drawings take longer


def quiet(sensor: SensorParameters) -> SensorParameters:
    """Return a sensor without leak and noise, whose events follow from the light alone."""
    return dataclasses.replace(sensor, leak_hz=0.0, noise=NoiseParameters())


@dataclass(frozen=True)
class Rung:
    """Cost and loss of a rig; times are wall time.

    Attributes
    ----------
    median, slowest : of the pieces: stream seconds for a wall second.
    p99_ms : of the time of a step.
    wrong_share : of the events of the light, see above; None: the light has none.
    memory_mib : of this process, resident.
    """

    median: float
    slowest: float
    p99_ms: float
    wrong_share: float | None
    memory_mib: float


class _Part(OtherLight):
    """Another scene from `begin_ns` on; closing it leaves that open."""

    begin_ns = 0

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self.refines = scene.refines

    def light(self, t_ns: int, out: Light) -> None:
        self.scene.light(t_ns + self.begin_ns, out)
        self.changed = self.scene.changed

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        self.scene.light_and_rate(t_ns + self.begin_ns, light, rate)
        self.changed = self.scene.changed

    @property
    def pixel_light(self) -> PixelLight | None:
        at, begin_ns = self.scene.pixel_light, self.begin_ns
        return None if at is None else lambda t_ns, pixels: at(t_ns + begin_ns, pixels)

    def close(self) -> None:
        """Do nothing."""


class Ladder(Closing):
    """The rungs of a rig, one after another, over the same exact scene, whose dearest instants are sought first."""

    def __init__(self, rig: Rig) -> None:
        run = dataclasses.replace(rig.run, quality=-1, drawing_us=rig.run.step_us, pace="free", lockstep_us=0)
        links = tuple(LINKS["loopback"].parameters(name=link.name) for link in rig.links)
        self._exact = dataclasses.replace(rig, run=run, links=links, trigger=None, faults=())
        self._step_ns = rig.run.step_us * 1000
        self.end_ns = round((rig.run.seconds or _UNLIMITED_S) * 1e9)
        self._scene = build_scene(self._exact)
        try:
            self.starts_ns = self._sweep()
            self._truth = self._light_events(self._exact, self._scene, _LIGHT_STEPS)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the scene."""
        self._scene.close()

    def _sweep(self) -> Sequence[int]:
        """Return the dearest instants of the run, ns, the dearest first."""
        source = build_sensor(self._exact, quiet(self._exact.camera.sensor))
        source.warm_up()
        frames, costs_s = build_frames(self._exact, self._scene), dict[int, float]()
        grid_ns, end_s = _GRID * self._step_ns, time.perf_counter() + _SWEEP_S
        for k in sorted(range(_SWEEP), key=lambda k: f"{k:04b}"[::-1]):  # finer and finer
            t_ns = k * self.end_ns // _SWEEP // grid_ns * grid_ns
            if t_ns not in costs_s and (len(costs_s) < _LEAST_SWEEP or time.perf_counter() < end_s):
                try:
                    costs_s[t_ns] = float(np.sum(step_costs(frames, source, t_ns, self._step_ns, 0.0)))
                except SceneError:  # it ends before
                    if not costs_s:
                        raise
        return sorted(costs_s, key=costs_s.__getitem__)[: -_DEAREST - 1 : -1]

    def climb(self, rig: Rig) -> Rung:
        """Measure the rung that a rig, equal but for its keys of quality, stands on."""
        gc.collect()  # what the rung before held goes, as far as the system's allocator gives it back
        getattr(ctypes.CDLL(None), "malloc_trim", int)(0)
        run = dataclasses.replace(rig.run, pace="free", lockstep_us=0, seconds=0.0)
        camera = dataclasses.replace(rig.camera, frames=None, imu=None)
        hosted = dataclasses.replace(self._exact, run=run, camera=camera)
        with drawn_seldom(_Part(self._scene), run) as scene:
            pieces, memory_mib = self._pieces(hosted, scene)
        if not pieces:
            raise SceneError(f"{rig.name}: its scene ends within {_NOT_COUNTED} steps")
        factors = [float(np.divide(*np.sum(piece, axis=0))) for piece in pieces]
        p99_ms = 1e3 * float(np.quantile(np.concatenate(pieces)[:, 1], 0.99))
        return Rung(float(np.median(factors)), min(factors), p99_ms, self.wrong_share(rig), memory_mib)

    def wrong_share(self, rig: Rig) -> float | None:
        """Return the wrong events of the light of a rung, see `Rung`."""
        if not any(map(len, self._truth)):
            return None
        with drawn_seldom(_Part(self._scene), rig.run) as scene:
            events = self._light_events(rig, scene, len(self._truth))
        compare = imported("laboratory.accuracy.scores:wrong_share")
        return float(compare(np.concatenate(events), np.concatenate(self._truth), *rig.camera.size))

    def _pieces(self, rig: Rig, scene: Scene) -> tuple[list[Floats], float]:
        """Return stream and wall time, s, of the steps of each piece, (n, 2), and the memory at their end, MiB."""
        part, ahead = _Part(scene), deque(self.starts_ns)
        part.begin_ns = ahead.popleft()
        session = build_session(rig, part, link_setups(rig), MonotonicClock())
        pieces = [list[tuple[float, float]]()]
        skipped, end_s = 0, math.inf
        last, begun = (0, 0.0), (0, 0.0)  # stream time, ns, and wall time, s

        def take(_: Events) -> None:
            nonlocal last, begun, skipped, end_s
            if session.stopping or session.t_ns == last[0]:  # what the read-out held
                return
            now = session.t_ns, time.perf_counter()
            end_s = min(end_s, now[1] + _RUNG_S)
            if skipped < _NOT_COUNTED:
                skipped, begun = skipped + 1, now
            else:
                pieces[-1].append(((now[0] - last[0]) * 1e-9, now[1] - last[1]))
            last, spent_s = now, now[1] - begun[1]
            is_period = now[0] - begun[0] >= rig.run.drawing_us * 1000
            is_long = spent_s > _PIECE_S and (is_period or spent_s > _LONGEST * _PIECE_S)
            if pieces[-1] and (is_long or now[0] + part.begin_ns >= self.end_ns):
                if not ahead or now[1] > end_s:
                    session.stop()
                else:
                    part.begin_ns, skipped = ahead.popleft() - now[0], 0
                    pieces.append([])

        result = session.run(schedule_of(rig), on_events=take)
        for link in result.links.values():
            if link.error:
                raise LinkFailed(f"{rig.name}: the host in place of a link: {link.error}")
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return [np.array(piece) for piece in pieces if piece], pages * resource.getpagesize() / 2**20

    def _light_events(self, rig: Rig, scene: Scene, steps: int) -> list[Events]:
        """Return the events of so many steps from the dearest instant on; of the exact scene fewer where it is slow."""
        source, frames = build_sensor(rig, quiet(rig.camera.sensor)), build_frames(rig, scene)
        t_ns, end_s = self.starts_ns[0], time.perf_counter() + _LIGHT_S
        source.reset(frames.draw(t_ns))
        events = list[Events]()
        while len(events) < steps and (scene is not self._scene or not events or time.perf_counter() < end_s):
            t_ns += self._step_ns
            try:
                events.append(source.expose(frames.draw(t_ns)))
            except SceneError:  # it ends before
                break
        return events
