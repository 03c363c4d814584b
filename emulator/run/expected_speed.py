"""Expected speed of a rig on this machine, from a probe of some seconds, and settings that would reach real time.

Scene, sensor and links make some steps at instants spread over the run, as a run that is not paced does. A loopback
stands for each link; its host starts the camera and decodes everything in the link's process. The cost of a step is
that of its light frame, that of its pixels, and the wait until the links have taken the last one. Frames and inertial
samples are left out. Where the rig is too slow it is probed again:

    longer steps       at steps four times as long: a + b step of a step, and the least step with a + b step < 0.9 step
    fewer pixels       with half as many on each side: a + b pixels, in the same way
    threads            with the number that the machine allows, where the rig sets one

A setting is named only where such a probe supports it.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np

from emulator.light import Scene, SceneFrames
from emulator.plan.plan import Plan
from emulator.rig.kinds import LINKS
from emulator.rig.loading import Rig, carries_second, second_rig
from emulator.run.assembly import build_frames, build_scene, build_sensor, link_setups
from emulator.run.link_process import LinkProcess
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import EventSource
from emulator.threads import available_threads
from firmware_protocol.events import Floats
from transports.link.pacing import MonotonicClock
from transports.link.rings import FREE_RUNNING

_INSTANTS = 4
_PROBE_S = 1.0
_LEAST_STEPS = 2  # at an instant
_BETWEEN_S = 2.0  # longest time for all steps from one instant to the next
_SPARE = 0.9  # of the wall time of a step that is real time, with some spare time
_LONGER = 4
_LONGEST_STEP_US = 1_000_000


@dataclass(frozen=True)
class StepCost:
    """Wall time of the light frame and of the pixels of a step of `step_s`, and of the wait for the links, s."""

    step_s: float
    drawing_s: float
    pixels_s: float
    links_s: float = 0.0

    @property
    def total_s(self) -> float:
        """Wall time of a step."""
        return self.drawing_s + self.pixels_s + self.links_s

    @property
    def factor(self) -> float:
        """Stream seconds for a wall second."""
        return self.step_s / self.total_s


@dataclass(frozen=True)
class ExpectedSpeed:
    """Expected speed of a rig with its links, and the settings any one of which would make it real time."""

    cost: StepCost
    remedies: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The speed as one sentence."""
        cost = self.cost
        parts = {"drawing": cost.drawing_s, "pixels": cost.pixels_s, "links": cost.links_s}
        shares = ", ".join(f"{name} {part_s / cost.total_s:.0%}" for name, part_s in parts.items())
        step = f"a step of {cost.step_s * 1e6:.0f} us takes {cost.total_s * 1e3:.3g} ms"
        text = f"{cost.factor:.2g} times real time expected: {step}, {shares}"
        if cost.factor > 1:
            return text
        if not self.remedies:
            return f"{text}; neither longer steps nor fewer pixels would make it real time"
        return f"{text}; {', or '.join(self.remedies)} would make it real time"

    def as_json(self) -> dict[str, object]:
        """Return the object `speed` of `evstim plan --json` and `evstim doctor --json`."""
        return {"times_real_time": self.cost.factor, **dataclasses.asdict(self.cost), "remedies": list(self.remedies)}


def expected_speed(rig: Rig, scene: Scene, plan: Plan | None) -> ExpectedSpeed:
    """Probe a rig for some seconds, and its remedies likewise where it is too slow.

    `plan` is that of its run; None for a recording, which has no remedies. Raises LinkFailed.
    """
    sensor = rig.camera.sensor if plan is None else plan.sensor
    step_us = rig.run.step_us if plan is None else plan.steps.step_us
    with hosted_links(rig) as links:
        cost = links.cost(rig, sensor, scene, round(step_us * 1000))
        remedies = () if plan is None or cost.factor > 1 else tuple(_remedies(plan, scene, links, cost))
    return ExpectedSpeed(cost, remedies)


def _remedies(plan: Plan, scene: Scene, links: HostedLinks, cost: StepCost) -> Iterator[str]:
    rig, step_ns = plan.rig, round(cost.step_s * 1e9)
    if 0 < rig.run.threads < available_threads():
        threaded = dataclasses.replace(rig, run=dataclasses.replace(rig.run, threads=0))
        with build_scene(threaded) as other:
            if links.cost(threaded, plan.sensor, other, step_ns).factor > 1:
                yield "run.threads = 0"
    if step_us := longer_step_us(cost, links.cost(rig, plan.sensor, scene, step_ns * _LONGER)):
        change = f"run.step_us = {step_us}" if plan.pinned else f"a run.tolerance_us that permits steps of {step_us} us"
        motion_px = plan.probe.motion_px_s * step_us * 1e-6  # long steps cost accuracy
        yield change + (f" ({motion_px:.2g} px of motion a step)" if math.isfinite(motion_px) else "")
    width, height = (max(2, side // 2) for side in rig.camera.size)
    sensor = dataclasses.replace(rig.camera.sensor, width=width, height=height)
    half = dataclasses.replace(rig, camera=dataclasses.replace(rig.camera, sensor=sensor))
    with build_scene(half) as other:
        planned = dataclasses.replace(plan.sensor, width=width, height=height)
        size_in_time = smaller_size(cost, links.cost(half, planned, other, step_ns), rig.camera.size)
    if size_in_time:
        yield f"a camera of {size_in_time[0]}x{size_in_time[1]} pixels"


def longer_step_us(cost: StepCost, longer: StepCost) -> int | None:
    """Return the least step in real time, from the costs of two; None where there is none up to a second."""
    slope = (longer.total_s - cost.total_s) / (longer.step_s - cost.step_s)
    if slope >= _SPARE:
        return None
    least_us = max(cost.total_s - slope * cost.step_s, 0.0) / (_SPARE - slope) * 1e6
    if least_us > _LONGEST_STEP_US:
        return None
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


@dataclass(eq=False)
class _Camera:
    """A camera of a rig, and its links."""

    frames: SceneFrames
    sensor: EventSource
    links: Sequence[LinkProcess]


@contextmanager
def hosted_links(rig: Rig) -> Iterator[HostedLinks]:
    """Start a link for each of the rig's, with a host in its process that reads everything; raises LinkFailed."""
    loopbacks = tuple(LINKS["loopback"].parameters(name=link.name) for link in rig.links)
    camera = dataclasses.replace(rig.camera, frames=None, imu=None)
    hosted = dataclasses.replace(rig, camera=camera, links=loopbacks, trigger=None, faults=())
    links = [LinkProcess(setup, MonotonicClock()) for setup in link_setups(hosted)]
    try:
        for link in links:
            link.wait_ready()
            link.start(FREE_RUNNING)
        yield HostedLinks(links)
    finally:
        for link in links:
            link.stop(0.0)


class HostedLinks:
    """Links in a run that is not paced; their time goes on where the stream jumps to another instant."""

    def __init__(self, links: Sequence[LinkProcess]) -> None:
        self._links = links
        self._t_us = 0

    def cost(self, rig: Rig, sensor: SensorParameters, scene: Scene, step_ns: int) -> StepCost:
        """Return the mean cost of a step at instants spread over the run."""
        with ExitStack() as stack:
            cameras = [self._camera(rig, sensor, scene)]
            if rig.second_camera is not None:
                second = second_rig(rig)
                cameras.append(self._camera(second, second.camera.sensor, stack.enter_context(build_scene(second))))
            return StepCost(step_ns * 1e-9, *self._costs_s(cameras, step_ns, rig.run.seconds or 10.0))

    def _camera(self, rig: Rig, sensor: SensorParameters, scene: Scene) -> _Camera:
        names = {link.name for link in rig.links if not carries_second(rig, link.name)}
        source = build_sensor(rig, sensor)
        source.warm_up()
        return _Camera(build_frames(rig, scene), source, [link for link in self._links if link.name in names])

    def _costs_s(self, cameras: Sequence[_Camera], step_ns: int, duration_s: float) -> list[float]:
        """Return the seconds of drawing, of pixels, and of links of a step.

        They are means without the first step after a start, as a few steps draw the noise of many pixels. All steps
        to the next instant are made if that is soon done: behind stars, pixels settle for seconds.
        """
        t_ns, stretches_s = 0, list[Floats]()
        for k in range(_INSTANTS):
            instant_ns = round(k / _INSTANTS * duration_s * 1e9)
            between = max(instant_ns - t_ns, 0) // step_ns
            if not stretches_s or between * stretches_s[-1].sum() > _BETWEEN_S:
                t_ns, between = instant_ns, 1
                for camera in cameras:
                    camera.sensor.reset(camera.frames.draw(t_ns))
            costs_s, end_s = list[Floats](), math.inf
            while len(costs_s) < between + _LEAST_STEPS or time.perf_counter() < end_s:
                if len(costs_s) == between:
                    self._wait()  # a link that loads or compiles kernels does so with its first events
                    end_s = time.perf_counter() + _PROBE_S / _INSTANTS
                costs_s.append(self._advance(cameras, t_ns, t_ns + step_ns))
                t_ns += step_ns
            stretches_s.append(np.mean(costs_s[between:], axis=0))
        return [float(part_s) for part_s in np.mean(stretches_s, axis=0)]

    def _wait(self) -> None:
        for link in self._links:
            link.wait_settled(self._t_us, lambda: True)

    def _advance(self, cameras: Sequence[_Camera], t0_ns: int, t1_ns: int) -> Floats:
        """Make a step of all cameras and return its seconds, (3,), as `_costs_s`."""
        costs_s, earlier_us = np.zeros(3), t0_ns // 1000 - self._t_us  # times of links against those of the stream
        for camera in cameras:
            begun_s = time.perf_counter()
            frame = camera.frames.draw(t1_ns)
            drawn_s = time.perf_counter()
            self._wait()
            settled_s = time.perf_counter()
            events = camera.sensor.expose(frame)
            exposed_s = time.perf_counter()
            events["t"] -= np.int64(earlier_us).view(np.uint64)
            for link in camera.links:
                link.push_all(events, t1_ns // 1000 - earlier_us)
            costs_s += drawn_s - begun_s, exposed_s - settled_s, settled_s - drawn_s + time.perf_counter() - exposed_s
        self._t_us = t1_ns // 1000 - earlier_us
        return costs_s
