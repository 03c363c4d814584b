"""One run of one rig: scene, sensor and links wired together, paced, counted and stopped cleanly.

    for each step [t, t1]:  light frame --+-> sensor -> events -> a ring for each link
                                          +-> frames, samples --> further rings, where a link has them

The way of an event from the pixel to the bus, with its forms and copies:

    Crossings -> EVENT (sensor) -> EVENT (ring of a link) -> EVENT (feed) -> queue of the device -> Items -> bus

docs/extend.md "The way of an event" names who makes each. `Fates` counts the events that a device drops on this way;
rings and faults count their own.

Paced in real time, a step is computed `lead` ahead of the moment its first event is due, and each link lets every event
go at its own time. Not paced, steps follow each other as fast as they can be computed and links hold the run back when
they are full, so that nothing is lost. In lockstep they go on as far as the SYNCs of a bus let them.

A part of the start that takes long is reported in the log.
"""

from __future__ import annotations

import dataclasses
import gc
import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

from emulator.light import Light, SceneEnded, SceneError, SceneFrames
from emulator.plan.step_control import StepSource
from emulator.run.camera import CameraView, ReadingSources, StepOutput
from emulator.run.changes import Change, Changes
from emulator.run.link_process import LinkProcess
from emulator.run.outcome import Ledger, RunResult, RunStatus
from emulator.run.pacing import Drive, Lateness, Lockstep, SimulationDrive, StepRule
from emulator.sensor.pixels.method import STOP, StepInterrupted
from emulator.sensor.sensor import AdjustableSource, EventSource, ThresholdSource
from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import Events
from transports.link.loop import Order
from transports.link.pacing import Clock
from transports.link.process import LinkSetup
from transports.link.report import CameraSettings, LinkReport, Occurrence
from transports.link.rings import FOREVER_US, FREE_RUNNING

log = logging.getLogger(__name__)


@contextmanager
def log_if_slow(message: str, after_s: float = 5.0) -> Iterator[None]:
    """Log `message` when the block has not ended after `after_s`."""
    timer = threading.Timer(after_s, log.info, [message])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def _without_old_garbage() -> Iterator[None]:
    """Leave the objects that exist now to no collection of garbage within the block: one takes 0.1 s, a late step."""
    if gc.get_freeze_count():  # the program did so itself
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


_STATUS_PERIOD_NS = 100_000_000
_SLICE_US = 20_000  # of a step, for rings of readings: a frame of a DAVIS346 takes 18 ms
_HEAD_START_NS = 60_000_000  # from the start until stream time zero: twice the time of the first step, the slowest


@dataclass(frozen=True)
class Schedule:
    """Schedule of a run. Above 0, `lockstep_ns` is the stream time for each SYNC on a link's bus, which drives the run.

    A `simulation` takes the place of such a bus, and the run is then not paced.
    A paced run whose worst step was later than `max_late_us`, or with a larger share of late steps than
    `max_late_share`, is not good; a `max_late_us` of 0 sets no limit.
    """

    lead_ns: int = 5_000_000
    duration_ns: int | None = None
    paced: bool = True
    drain_s: float = 1.0
    lockstep_ns: int = 0
    max_late_us: float = 0.0
    max_late_share: float = 1.0
    simulation: SimulationDrive | None = None


class Session:
    """One run from the first light to the last report.

    Parameters
    ----------
    frames : light frames of the camera's scene; the caller closes the scene.
    sensor : from light to events.
    steps : length of each step.
    setups : one for each link.
    clock : clock that paces the run.
    readings : readings of the camera beside events.
    """

    def __init__(
        self,
        frames: SceneFrames,
        sensor: EventSource,
        steps: StepSource,
        setups: Sequence[LinkSetup[Any]],
        clock: Clock,
        readings: ReadingSources | None = None,
    ) -> None:
        size = (sensor.parameters.width, sensor.parameters.height)
        if frames.scene.size != size:
            raise ValueError(f"the scene is {frames.scene.size} pixels, the sensor {size}")
        self._changes = Changes()
        names = [setup.name for setup in setups]
        self._first = CameraView(frames, sensor, readings or ReadingSources((), setups), names, self._changes)
        self._second: CameraView | None = None
        self._step_source = steps
        self._setups = setups
        self._clock = clock
        self._links: list[LinkProcess] = []
        self._schedule = Schedule()
        self._lockstep: Lockstep | None = None
        self._drive: Drive | None = None
        self._on_events: Callable[[Events], None] = lambda _: None
        self._steps = 0
        self.t_ns = 0
        self._lateness = Lateness()
        self.stopping = False
        self._may_interrupt = True
        self._in_steps = False
        self._cut_off: Ledger | None = None
        self._scene_trouble = ""
        self.last_readings: Sequence[tuple[ReadingKind, Readings]] = ()

    def join(self, second: CameraView) -> None:
        """Add a second camera on the same clock, before the run; its scene is closed at the end."""
        self._second = second
        self._first.links -= second.links
        second.record_in(self._changes)

    def stop(self) -> None:
        """End the run after the present step; for `on_status`, and for a signal handler."""
        self.stopping = True
        self._first.frames.scene.stop()

    def interrupt(self) -> None:
        """End the run within the present step, for a signal handler; raises KeyboardInterrupt where that is possible.

        Light and events of the step are discarded. Before the first step it interrupts the start; while events are
        handed over and after the last step, which have bounds of their own, it does nothing: every event has a fate.
        """
        self.stopping = True
        if self._may_interrupt:
            raise StepInterrupted

    def end_step(self) -> None:
        """End a present step, as `interrupt` does, from another thread while this one computes the pixels of it."""
        STOP[0] = self._in_steps

    @property
    def light(self) -> Light:
        """The light that the sensor sees, (height, width) float32; the next step draws over it."""
        return self._first.frames.last.light

    def state(self) -> tuple[int, CameraView, Mapping[str, Any]]:
        """Return time, camera and what selects the steps, of a run without links between two steps; no copies."""
        return self.t_ns, self._first, vars(self._step_source)

    def restore(self, t_ns: int, camera: CameraView, steps: Mapping[str, Any]) -> None:
        """Go to a state of this session, between two steps."""
        self.t_ns, self._first = t_ns, camera
        vars(self._step_source).update(steps)

    @property
    def changes(self) -> tuple[Change, ...]:
        """Changes from outside so far, in the order in which they came."""
        return self._changes.in_order

    @property
    def adjustable(self) -> dict[str, float]:
        """Sensor parameters that `adjust` can change, with their present values."""
        return sensor.adjustable if isinstance(sensor := self._first.sensor, AdjustableSource) else {}

    def adjust(self, name: str, value: float, by: str = "program") -> None:
        """Change a sensor parameter from the next step on; for `on_status` and `on_events`; raises ValueError.

        `by` stands in the record of the run, here and below.
        """
        sensor = self._first.sensor
        if not isinstance(sensor, AdjustableSource):
            raise ValueError(f"{name} cannot be changed: a recording stands in the sensor's place")
        before = sensor.adjustable.get(name)
        sensor.adjust(name, value)
        self.record(Change(self.t_ns, by, name, before=before, after=value))

    def thresholds_of(self, x: int, y: int) -> tuple[float, float]:
        """Return the ON and OFF threshold of a pixel of the sensor; raises ValueError where there is none."""
        sensor = self._first.sensor
        if not isinstance(sensor, ThresholdSource):
            raise ValueError("a recording stands in the sensor's place: its pixels have no thresholds")
        return sensor.thresholds_of(x, y)

    def order(self, link: str, order: Order) -> None:
        """Begin a fault that a link can have, or end it; or give its camera an edge, or reset it; for `on_status`."""
        next(other for other in self._links if other.name == link).order(order)

    def record(self, change: Change) -> None:
        """Record a change of the run from outside."""
        self._changes.add(change)

    def run(
        self,
        schedule: Schedule,
        on_status: Callable[[RunStatus], None] = lambda _: None,
        on_events: Callable[[Events], None] = lambda _: None,
    ) -> RunResult:
        """Run until the schedule's end, `stop`, or the death of the last link; raises LinkFailed if one cannot open.

        `on_events` receives the events of each step, after the links; it may keep them.
        """
        self._schedule = schedule
        self._on_events = on_events
        with ExitStack() as stack:
            if self._second is not None:
                stack.callback(self._second.frames.scene.close)
            stack.callback(self._stop_links, 0.0)  # does nothing more when the links have been stopped in order
            self._open_links()
            if schedule.simulation is not None:
                schedule.simulation.begin(lambda: self.light, self._reporting(on_status, None))
            self._step_source.observe(self._first.begin())  # the first light frame, before the clock runs
            if self._second is not None:
                self._second.begin()
            stack.enter_context(_without_old_garbage())
            start_ns = self._clock.now_ns()
            self._in_steps = True
            try:
                self._run_steps(on_status)
            finally:
                STOP[0] = self._in_steps = False
            wall_seconds = (self._clock.now_ns() - start_ns) * 1e-9
            self._finish()
            reports = self._stop_links(schedule.drain_s)
        scene = self._first.frames.scene
        return RunResult(
            sim_seconds=self.t_ns * 1e-9,
            wall_seconds=wall_seconds,
            frames=self._first.frames.count,
            steps=self._steps,
            ledger=self._ledger(reports),
            lateness=self._lateness,
            links=reports,
            undersampled_share=self._first.sensor.undersampled_share,
            scene_counts=scene.counts,
            painter=scene.painter,
            renderer=scene.renderer,
            syncs=None if self._lockstep is None else self._lockstep.received,
            max_late_us=schedule.max_late_us if schedule.paced else 0.0,
            max_late_share=schedule.max_late_share,
            changes=self._changes.listed,
            changes_beyond=self._changes.beyond,
            scene_trouble=self._scene_trouble,
        )

    def _open_links(self) -> None:
        """Start the processes of the links, and load the sensor's kernels while they start."""
        self._links = [LinkProcess(setup, self._clock) for setup in self._setups]
        with log_if_slow("compiling the kernels of the sensor: up to half a minute, once; they are cached on disk"):
            self._first.sensor.warm_up()
        with log_if_slow("opening the links takes long: something is compiled, or the machine is busy"):
            for link in self._links:
                link.wait_ready()
                log.info("%s: %s", link.name, link.report.state)
                if link.report.attach_command:
                    log.info("%s: attach a host: %s", link.name, link.report.attach_command)

    def _run_steps(self, on_status: Callable[[RunStatus], None]) -> None:
        schedule = self._schedule
        self._may_interrupt = False
        start_ns = self._clock.now_ns()
        if schedule.lockstep_ns:
            rings = [setup.timing.syncs for setup in self._setups if setup.timing.syncs is not None]
            if not rings:
                raise ValueError("no link's bus drives this run")
            self._lockstep = Lockstep(rings[0], schedule.lockstep_ns, self._clock)
        self._drive = schedule.simulation or self._lockstep
        origin_ns = start_ns + _HEAD_START_NS if schedule.paced else FREE_RUNNING
        for link in self._links:
            link.start(origin_ns)
        rule = StepRule(self._step_source)
        goes_on = self._reporting(on_status, start_ns)
        while self._goes_on() and (schedule.duration_ns is None or self.t_ns < schedule.duration_ns):
            lead_ns = max(schedule.lead_ns, rule.step_ns)
            if schedule.paced:
                if self.t_ns:  # the first step begins at once
                    self._clock.sleep_until(origin_ns + self.t_ns - lead_ns)
            elif self._drive is not None and self._drive.wait(self.t_ns, goes_on) <= self.t_ns:
                break
            due_ns, begun_ns = origin_ns + self.t_ns, self._clock.now_ns()
            processor_ns = self._clock.processor_ns()
            try:
                self._step(rule, goes_on)
            except (SceneError, StepInterrupted) as error:  # the events so far have their fates
                self._scene_trouble = self._trouble_of(error)
                break
            finally:
                self._may_interrupt = False
            if schedule.paced:
                ready_ns = self._clock.now_ns()
                self._lateness.add(ready_ns - due_ns, rule.stretch, lead_ns)
                rule.follow(ready_ns - due_ns, ready_ns - begun_ns)
                self._lateness.computing_ns += ready_ns - begun_ns
                self._lateness.processor_ns += self._clock.processor_ns() - processor_ns
            goes_on()

    def _goes_on(self) -> bool:
        """Return False when the run was stopped, or it has links and all of them are gone."""
        return not self.stopping and (not self._links or any(not link.gone for link in self._links))

    def _trouble_of(self, error: BaseException) -> str:
        """Return the reason for the verdict; "" for a regular end of the scene where a run has none, or was stopped."""
        t_s = self.t_ns * 1e-9
        if isinstance(error, StepInterrupted):
            text = f"interrupted within the step after {t_s:g} s, which is discarded"
            if not STOP[0]:
                return text
            log.info("%s", text)  # a first signal: the run ends as it was to end, only sooner
            return ""
        log.info("the scene ends at %g s: %s", t_s, error)
        if not isinstance(error, SceneEnded):
            return str(error)
        duration_ns = self._schedule.duration_ns
        return "" if duration_ns is None or self.stopping else f"{error} after {t_s:g} of {duration_ns * 1e-9:g} s"

    def _reporting(self, on_status: Callable[[RunStatus], None], start_ns: int | None) -> Callable[[], bool]:
        """Return a function that reports the status now and then, and returns whether the run goes on.

        `start_ns` is None for a run that has not begun.
        """
        status_ns = self._clock.now_ns()

        def goes_on() -> bool:
            nonlocal status_ns
            if self._clock.now_ns() >= status_ns:
                status_ns = self._clock.now_ns() + _STATUS_PERIOD_NS
                on_status(self._status(self._clock.now_ns() if start_ns is None else start_ns))
            return self._goes_on()

        return goes_on

    def _step(self, rule: StepRule, goes_on: Callable[[], bool]) -> None:
        """Draw the light of the next step, compute the events of it, and hand them over to the links."""
        first, is_paced = self._first, self._schedule.paced
        t1_ns = self._end_of_step(rule.step_ns)
        with self._interruptible():
            frame = first.frames.draw(t1_ns)
        self._follow_cameras(goes_on)
        readings = self.last_readings = first.readings.read(frame)
        if is_paced:  # they may leave while the events are computed
            self._push_readings(readings, self._links_of(first))
        self._cut_off = first.ledger_if_it_ends()
        with self._interruptible():
            events = first.sensor.expose(frame)
        self._cut_off = None
        self._step_source.observe(frame)
        t0_ns, self.t_ns = self.t_ns, t1_ns
        self._steps += 1
        self._hand_over(StepOutput(events, () if is_paced else readings), t0_ns, first)
        self._on_events(events)
        if self._second is not None:
            self._hand_over(self._second.step(t1_ns), t0_ns, self._second)

    def _end_of_step(self, step_ns: int) -> int:
        """Return the stream time at which a step of at most this length ends."""
        t1_ns = self.t_ns + step_ns
        if isinstance(self._first.sensor, AdjustableSource):
            t1_ns = min(t1_ns, self.t_ns + self._first.sensor.longest_step_ns)
        if self._drive is not None:
            t1_ns = min(t1_ns, self._drive.limit_ns)
        period_ns = self._schedule.lockstep_ns
        if period_ns:  # steps end with each period, however many SYNCs have come
            t1_ns = min(t1_ns, (self.t_ns // period_ns + 1) * period_ns)
        return t1_ns if self._schedule.duration_ns is None else min(t1_ns, self._schedule.duration_ns)

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let `interrupt` act within the block."""
        self._may_interrupt = True
        try:
            yield
        except SystemError as error:  # numba raises it where a signal does while the result of a kernel is made
            if isinstance(error.__cause__, StepInterrupted):
                raise error.__cause__ from None
            raise
        finally:
            self._may_interrupt = False

    def _follow_cameras(self, goes_on: Callable[[], bool]) -> None:
        """Apply to the sensors, at the end of a step, the changes that hosts made at their cameras before it.

        A run that is not paced waits until the cameras are there too, so that no such change is still to come.
        """
        now_us = self.t_ns // 1000
        for link in self._links if not self._schedule.paced else ():
            link.wait_settled(now_us, goes_on)
        for link in self._links:
            for change in link.take_changes(now_us):
                self._take_change(link.name, change)

    def _take_change(self, link: str, change: CameraSettings | Occurrence) -> None:
        if isinstance(change, Occurrence):
            t_us, fault = change.t_us, change.fault
            self.record(Change(t_us * 1000, change.by, change.what, link, taken_us=t_us, fault=fault))
            return
        self._first.follow(link, change, self.t_ns)
        if self._second is not None:
            self._second.follow(link, change, self.t_ns)

    def _links_of(self, camera: CameraView) -> list[LinkProcess]:
        return [link for link in self._links if link.name in camera.links]

    def _hand_over(self, output: StepOutput, t0_ns: int, camera: CameraView) -> None:
        """Hand over the output of a camera's step from `t0_ns` to its links.

        A run that is not paced waits for room; its readings go in slices of the step, as rings are finite.
        """
        links, is_paced = self._links_of(camera), self._schedule.paced
        is_sliced = not is_paced and any(len(records) for _, records in output.readings)
        pieces = output.pieces(t0_ns // 1000, self.t_ns // 1000, _SLICE_US if is_sliced else None)
        for until_us, piece in pieces:
            self._push_readings(piece.readings, links, None if is_paced else self._goes_on)
            for link in links:
                if is_paced:
                    link.push(piece.events, until_us)
                else:
                    link.push_all(piece.events, until_us, self._goes_on)

    def _push_readings(
        self,
        readings: Sequence[tuple[ReadingKind, Readings]],
        links: Sequence[LinkProcess],
        goes_on: Callable[[], bool] | None = None,
    ) -> None:
        for kind, records in readings:
            for link in links:
                link.push_readings(kind, records, goes_on)

    def _finish(self) -> None:
        """Hand over the events that the read-outs still hold."""
        if self._cut_off is None:
            events = self._first.sensor.finish()
            self._hand_over(StepOutput(events), self.t_ns, self._first)
            self._on_events(events)
        if self._second is not None:
            self._hand_over(StepOutput(self._second.sensor.finish()), self.t_ns, self._second)

    def _status(self, start_ns: int) -> RunStatus:
        sensor = self._first.sensor
        return RunStatus(
            sim_seconds=self.t_ns * 1e-9,
            wall_seconds=(self._clock.now_ns() - start_ns) * 1e-9,
            frames=self._first.frames.count,
            read_out=sensor.read_out,
            lateness=self._lateness,
            links={link.name: link.listen() for link in self._links},
            raised=sensor.raised,
            lost_in_pixel=sensor.lost_in_pixel,
            lost_at_readout=sensor.lost_at_readout,
        )

    def _stop_links(self, drain_s: float) -> dict[str, LinkReport]:
        links, self._links = self._links, []
        reports = {link.name: link.stop(drain_s) for link in links}
        for link in links:
            for change in link.take_changes(FOREVER_US):
                if isinstance(change, Occurrence):  # settings act on no step any more
                    self._take_change(link.name, change)
        return reports

    def _ledger(self, reports: dict[str, LinkReport]) -> Ledger:
        second = None if self._second is None else self._second.ledger(reports)
        ledger = self._first.ledger(reports, second)
        if self._cut_off is None:
            return ledger
        return dataclasses.replace(self._cut_off, links=ledger.links, second=second)
