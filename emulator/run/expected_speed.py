"""Expected speed of a rig on this machine, from a probe of about a second, and settings that would reach real time.

Scene and sensor make some steps at instants spread over the run; links have processes of their own and are not probed.
The cost of a step is that of its light frame and that of its pixels. Where the rig is too slow it is probed again:

    longer steps       at steps four times as long: a + b step of a step, and the least step with a + b step < 0.9 step
    fewer pixels       with half as many on each side: a + b pixels, in the same way
    threads            with the number that the machine allows, where the rig sets one

A setting is named only where such a probe supports it.

`keeping_up` measures the speed instead: it computes some seconds of the stream, with the whole session but links.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass

from emulator.light import Scene, SceneFrames
from emulator.plan.plan import Plan
from emulator.rig.kinds import SCENES
from emulator.rig.loading import Rig
from emulator.run.assembly import build_frames, build_scene, build_sensor, build_session, plan_of, schedule
from emulator.run.outcome import RunStatus
from emulator.sensor.sensor import EventSource
from emulator.threads import available_threads
from transports.link.pacing import MonotonicClock

_INSTANTS = 4
_PROBE_S = 1.0
_LEAST_STEPS = 2  # at an instant
_SPARE = 0.9  # of the wall time of a step that is real time, with some spare time
_LONGER = 4
_LONGEST_STEP_US = 1_000_000


@dataclass(frozen=True)
class StepCost:
    """Wall time of the light frame and of the pixels of a step of `step_s`, s."""

    step_s: float
    drawing_s: float
    pixels_s: float

    @property
    def total_s(self) -> float:
        """Wall time of a step."""
        return self.drawing_s + self.pixels_s

    @property
    def factor(self) -> float:
        """Stream seconds for a wall second."""
        return self.step_s / self.total_s


@dataclass(frozen=True)
class ExpectedSpeed:
    """Expected speed of a rig, without links, and the settings any one of which would make it real time."""

    cost: StepCost
    remedies: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The speed as one sentence."""
        cost = self.cost
        share = cost.drawing_s / cost.total_s
        shares = f"drawing {share:.0%}, pixels {1 - share:.0%}"
        text = (
            f"{cost.factor:.2g} times real time expected on this machine, without links: a step of "
            f"{cost.step_s * 1e6:.0f} us takes {cost.total_s * 1e3:.3g} ms, {shares}"
        )
        if cost.factor > 1:
            return text
        if not self.remedies:
            return f"{text}; neither longer steps nor fewer pixels would make it real time"
        return f"{text}; {', or '.join(self.remedies)} would make it real time"

    def as_json(self) -> dict[str, object]:
        """Return the object `speed` of `evstim plan --json` and `evstim doctor --json`."""
        costs = dataclasses.asdict(self.cost)
        return {"times_real_time": self.cost.factor, **costs, "remedies": list(self.remedies)}


def expected_speed(plan: Plan, scene: Scene) -> ExpectedSpeed:
    """Probe a planned rig for about a second, and its remedies for another one where it is too slow."""
    step_ns, duration_s = round(plan.steps.step_us * 1000), plan.rig.run.seconds or 10.0
    cost = _cost(plan, scene, step_ns, duration_s)
    remedies = () if cost.factor > 1 else tuple(_remedies(plan, scene, cost, duration_s))
    return ExpectedSpeed(cost, remedies)


def _remedies(plan: Plan, scene: Scene, cost: StepCost, duration_s: float) -> Iterator[str]:
    step_ns = round(cost.step_s * 1e9)
    if 0 < plan.rig.run.threads < available_threads():
        rig = dataclasses.replace(plan.rig, run=dataclasses.replace(plan.rig.run, threads=0))
        with build_scene(rig) as other:
            if _cost(dataclasses.replace(plan, rig=rig), other, step_ns, duration_s).factor > 1:
                yield "run.threads = 0"
    if step_us := longer_step_us(cost, _cost(plan, scene, step_ns * _LONGER, duration_s)):
        yield _step_text(plan, step_us)
    camera = plan.rig.camera
    width, height = (max(2, side // 2) for side in camera.size)
    half_camera = dataclasses.replace(camera, sensor=dataclasses.replace(camera.sensor, width=width, height=height))
    half = dataclasses.replace(plan, rig=dataclasses.replace(plan.rig, camera=half_camera))
    with build_scene(half.rig) as other:
        size_in_time = smaller_size(cost, _cost(half, other, step_ns, duration_s), camera.size)
    if size_in_time:
        yield f"a camera of {size_in_time[0]}x{size_in_time[1]} pixels"


def longer_step_us(cost: StepCost, longer: StepCost) -> int | None:
    """Return the least step in real time, from the costs of two; None where there is none up to a second."""
    slope = (longer.total_s - cost.total_s) / (longer.step_s - cost.step_s)
    least_s = _least(cost.total_s - slope * cost.step_s, slope)
    if least_s is None or least_s * 1e6 > _LONGEST_STEP_US:
        return None
    least_us = least_s * 1e6
    unit_us = math.pow(10, max(0, math.floor(math.log10(max(least_us, 1.0))) - 1))  # rounded up to two digits
    return round(math.ceil(least_us / unit_us) * unit_us)


def smaller_size(cost: StepCost, half: StepCost, size: tuple[int, int]) -> tuple[int, int] | None:
    """Return the largest size of these proportions in real time; `half` is the cost with half the sides."""
    pixels = size[0] * size[1]
    a_pixel_s = (cost.total_s - half.total_s) / (pixels * 3 / 4)
    if a_pixel_s <= 0:
        return None
    most_pixels = (_SPARE * cost.step_s - (cost.total_s - a_pixel_s * pixels)) / a_pixel_s
    share = math.sqrt(most_pixels / pixels) if most_pixels > 0 else 0.0
    width, height = (int(side * share) // 2 * 2 for side in size)
    return (width, height) if min(width, height) >= 2 else None


def _least(fixed_s: float, slope: float) -> float | None:
    """Return the least step, s, of a cost `fixed_s` + `slope` step that is in real time; None for none."""
    return max(fixed_s, 0.0) / (_SPARE - slope) if slope < _SPARE else None


def _step_text(plan: Plan, step_us: int) -> str:
    """Return the change that gives such steps, with the motion of the image in one: long steps cost accuracy."""
    motion_px = plan.probe.motion_px_s * step_us * 1e-6
    motion = f" ({motion_px:.2g} px of motion a step)" if math.isfinite(motion_px) else ""
    change = f"run.step_us = {step_us}" if plan.pinned else f"a run.tolerance_us that permits steps of {step_us} us"
    return change + motion


def _cost(plan: Plan, scene: Scene, step_ns: int, duration_s: float) -> StepCost:
    """Return the mean cost of a step at instants spread over the run."""
    frames, sensor = build_frames(plan.rig, scene), build_sensor(plan.rig, plan.sensor)
    sensor.warm_up()
    instants_ns = [round((k + 0.5) / _INSTANTS * duration_s * 1e9) for k in range(_INSTANTS)]
    costs = [_cost_at(frames, sensor, t_ns, step_ns) for t_ns in instants_ns]
    drawing_s, pixels_s = (sum(column) / _INSTANTS for column in zip(*costs, strict=True))
    return StepCost(step_ns * 1e-9, drawing_s, pixels_s)


def _cost_at(frames: SceneFrames, sensor: EventSource, t_ns: int, step_ns: int) -> tuple[float, float]:
    """Return seconds of drawing and of pixels of a step from an instant on.

    These are means, because a few steps draw the noise of many pixels; the first step settles and is left out.
    """
    sensor.reset(frames.draw(t_ns))
    drawing_s, pixels_s = list[float](), list[float]()
    end_s = time.perf_counter() + _PROBE_S / _INSTANTS
    while len(drawing_s) <= _LEAST_STEPS or time.perf_counter() < end_s:
        t_ns += step_ns
        begun_s = time.perf_counter()
        frame = frames.draw(t_ns)
        drawn_s = time.perf_counter()
        sensor.expose(frame)
        drawing_s.append(drawn_s - begun_s)
        pixels_s.append(time.perf_counter() - drawn_s)
    return statistics.fmean(drawing_s[1:]), statistics.fmean(pixels_s[1:])


_STREAM_S, _WALL_S = 2.0, 10.0


@dataclass(frozen=True)
class RealTimeSpeed:
    """Speed of a rig on this machine.

    Attributes
    ----------
    times_real_time : stream seconds for a second of this machine, scene and sensor without links.
    stream_s : stream time that was computed for this.
    expected : speed expected from a probe over the whole run; None for a recording, which has no plan.
    """

    times_real_time: float
    stream_s: float
    expected: ExpectedSpeed | None = None

    @property
    def good(self) -> bool:
        """Return whether the rig runs in real time here."""
        return self.times_real_time > 1


def keeping_up(rig: Rig) -> RealTimeSpeed:
    """Compute up to two seconds of a rig's stream without pacing, for at most ten seconds."""
    with build_scene(rig) as scene:
        expected = None
        if not SCENES[rig.scene.kind].events:
            expected = expected_speed(plan_of(rig, scene), scene)
        session = build_session(rig, scene, [], MonotonicClock())

        def follow(now: RunStatus) -> None:
            if now.wall_seconds > _WALL_S:
                session.stop()

        stream_s = min(_STREAM_S, rig.run.seconds or _STREAM_S)
        free = dataclasses.replace(schedule(rig), duration_ns=round(stream_s * 1e9), paced=False, lockstep_ns=0)
        result = session.run(free, follow)
    return RealTimeSpeed(result.sim_seconds / result.wall_seconds, result.sim_seconds, expected)
