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
from typing import Any, TypeVar

from emulator.light import Light, SceneEnded, SceneError, SceneFrames
from emulator.plan.step_control import StepSource
from emulator.run.changes import BiasFollowing, Change, Changes
from emulator.run.link_process import LinkProcess
from emulator.run.outcome import Ledger, RunResult, RunStatus
from emulator.run.pacing import Drive, Lateness, Lockstep, Simulation, StepRule
from emulator.run.readings import ReadingSources, StepOutput
from emulator.run.stereo import SecondView, ledger_of
from emulator.sensor.sensor import AdjustableSource, EventSource, ThresholdSource
from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import EdgeKind, Events
from transports.faults.kinds import Fault
from transports.link.pacing import Clock
from transports.link.process import LinkSetup
from transports.link.report import CameraSettings, LinkReport, Occurrence
from transports.link.rings import FREE_RUNNING

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


_T = TypeVar("_T")

_FOREVER_US = 1 << 62
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
    simulation: Simulation | None = None


class _StepInterrupted(KeyboardInterrupt):
    """End of a run within a step, see `Session.interrupt`."""


def _cut_off(ledger: Ledger) -> Ledger:
    """Return the fates of a sensor's events if it gives none from now on: those that wait are lost at the read-out."""
    return dataclasses.replace(ledger, lost_at_readout=ledger.raised - ledger.lost_in_pixel - ledger.read_out)


class Session:
    """One run from the first light to the last report.

    Parameters
    ----------
    frames
        Light frames of the camera's scene; the caller closes the scene.
    sensor
        From light to events.
    steps
        Length of each step.
    setups
        One for each link.
    clock
        Clock that paces the run.
    readings
        Readings of the camera beside events.
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
        self._frames = frames
        self._sensor = sensor
        self._changes = Changes()
        self._biases = BiasFollowing(sensor, self._changes)
        self._step_source = steps
        self._setups = setups
        self._readings = readings or ReadingSources((), setups)
        self._clock = clock
        self._links: list[LinkProcess] = []
        self._steps = 0
        self._t_ns = 0
        self._lateness = Lateness()
        self._stopping = False
        self._may_interrupt = True
        self._cut_off: Ledger | None = None
        self._scene_trouble = ""
        self._on_events: Callable[[Events], None] = lambda _: None
        self._lockstep: Lockstep | None = None
        self._drive: Drive | None = None
        self._last_readings: Sequence[tuple[ReadingKind, Readings]] = ()

        self._second: SecondView | None = None

    def join(self, second: SecondView) -> None:
        """Add a second camera on the same clock, before the run; its scene is closed at the end."""
        self._second = second
        second.record_in(self._changes)

    def stop(self) -> None:
        """End the run after the present step; for `on_status`, and for a signal handler."""
        self._stopping = True
        self._frames.scene.stop()

    def interrupt(self) -> None:
        """End the run within the present step, for a signal handler; raises KeyboardInterrupt where that is possible.

        Light and events of the step are discarded. Before the first step it interrupts the start; while events are
        handed over and after the last step, which have bounds of their own, it does nothing: every event has a fate.
        """
        self._stopping = True
        if self._may_interrupt:
            raise _StepInterrupted

    @property
    def stopping(self) -> bool:
        """True after `stop`."""
        return self._stopping

    @property
    def t_ns(self) -> int:
        """Stream time of the last step's end."""
        return self._t_ns

    @property
    def light(self) -> Light:
        """The light that the sensor sees, (height, width) float32; the next step draws over it."""
        return self._frames.last.light

    @property
    def last_readings(self) -> Sequence[tuple[ReadingKind, Readings]]:
        """Frames and inertial samples of the last step, by their kind."""
        return self._last_readings

    @property
    def changes(self) -> tuple[Change, ...]:
        """Changes from outside so far, in the order in which they came."""
        return self._changes.in_order

    @property
    def adjustable(self) -> dict[str, float]:
        """Sensor parameters that `adjust` can change, with their present values."""
        return self._sensor.adjustable if isinstance(self._sensor, AdjustableSource) else {}

    def adjust(self, name: str, value: float, by: str = "program") -> None:
        """Change a sensor parameter from the next step on; for `on_status` and `on_events`; raises ValueError.

        `by` stands in the record of the run, here and below.
        """
        if not isinstance(self._sensor, AdjustableSource):
            raise ValueError(f"{name} cannot be changed: a recording stands in the sensor's place")
        before = self._sensor.adjustable.get(name)
        self._sensor.adjust(name, value)
        self.record(Change(self._t_ns, by, name, before=before, after=value))

    def thresholds_of(self, x: int, y: int) -> tuple[float, float]:
        """Return the ON and OFF threshold of a pixel of the sensor; raises ValueError where there is none."""
        if not isinstance(self._sensor, ThresholdSource):
            raise ValueError("a recording stands in the sensor's place: its pixels have no thresholds")
        return self._sensor.thresholds_of(x, y)

    def inject(self, fault: Fault, by: str = "program") -> None:
        """Begin a fault on the link that it names, one that this link can have; for `on_status`."""
        next(link for link in self._links if link.name == fault.link).inject(fault, by)

    def end_fault(self, link: str, number: int, by: str = "program") -> None:
        """End the fault with this number on a link; for `on_status`."""
        next(one for one in self._links if one.name == link).end_fault(number, by)

    def happen(self, link: str, kind: EdgeKind | None, by: str = "program") -> None:
        """Give the input of a link's camera an edge, or reset its clock (None); for `on_status`."""
        next(one for one in self._links if one.name == link).happen(kind, by)

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
        self._on_events = on_events
        with ExitStack() as stack:
            if self._second is not None:
                stack.callback(self._second.close)
            stack.callback(self._stop_links, 0.0)  # does nothing more when the links have been stopped in order
            self._open_links()
            if schedule.simulation is not None:
                schedule.simulation.begin(lambda: self.light, self._reporting(on_status, None))
            self._warm_up()
            stack.enter_context(_without_old_garbage())
            start_ns = self._clock.now_ns()
            self._run_steps(schedule, on_status)
            wall_seconds = (self._clock.now_ns() - start_ns) * 1e-9
            self._finish(schedule)
            reports = self._stop_links(schedule.drain_s)
        scene, ledger = self._frames.scene, self._ledger(reports)
        return RunResult(
            sim_seconds=self._t_ns * 1e-9,
            wall_seconds=wall_seconds,
            frames=self._frames.count,
            steps=self._steps,
            ledger=ledger,
            lateness=self._lateness,
            links=reports,
            undersampled_share=self._sensor.undersampled_share,
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

    def _finish(self, schedule: Schedule) -> None:
        """Hand over the events that the read-outs still hold."""
        if self._cut_off is None:
            events = self._sensor.finish()
            self._hand_over(events, schedule, self._links_of())
            self._on_events(events)
        if self._second is not None:
            self._hand_over(self._second.finish(), schedule, self._links_of(second=True))

    def _open_links(self) -> None:
        """Start the processes of the links, and load the sensor's kernels while they start."""
        self._links = [LinkProcess(setup, self._clock) for setup in self._setups]
        with log_if_slow("compiling the kernels of the sensor: up to half a minute, once; they are cached on disk"):
            self._sensor.warm_up()
        with log_if_slow("opening the links takes long: something is compiled, or the machine is busy"):
            for link in self._links:
                link.wait_ready()
                log.info("%s: %s", link.name, link.report.state)
                if link.report.attach_command:
                    log.info("%s: attach a host: %s", link.name, link.report.attach_command)

    def _warm_up(self) -> None:
        """Draw the first light frame before the clock runs."""
        frame = self._frames.draw(0)
        self._sensor.reset(frame)
        self._readings.reset(frame)
        self._step_source.observe(frame)
        if self._second is not None:
            self._second.begin()

    def _run_steps(self, schedule: Schedule, on_status: Callable[[RunStatus], None]) -> None:
        self._may_interrupt = False
        start_ns = self._clock.now_ns()
        self._lockstep = self._locked(schedule)
        self._drive = schedule.simulation or self._lockstep
        origin_ns = start_ns + _HEAD_START_NS if schedule.paced else FREE_RUNNING
        for link in self._links:
            link.start(origin_ns)
        rule, goes_on = StepRule(self._step_source), self._reporting(on_status, start_ns)
        while self._goes_on and (schedule.duration_ns is None or self._t_ns < schedule.duration_ns):
            lead_ns = max(schedule.lead_ns, rule.step_ns)
            if schedule.paced:
                if self._t_ns:  # the first step begins at once
                    self._clock.sleep_until(origin_ns + self._t_ns - lead_ns)
            elif not self._may_go_on(goes_on):
                break
            due_ns, begun_ns = origin_ns + self._t_ns, self._clock.now_ns()
            if not self._stepped(rule, schedule, goes_on):
                break
            if schedule.paced:
                ready_ns = self._clock.now_ns()
                self._lateness.add(ready_ns - due_ns, rule.stretch, lead_ns)
                rule.follow(ready_ns - due_ns, ready_ns - begun_ns)
            goes_on()

    def _stepped(self, rule: StepRule, schedule: Schedule, goes_on: Callable[[], bool]) -> bool:
        """Do one step; False where the scene has no light for it: the events so far have their fates."""
        try:
            self._step(rule, schedule, goes_on)
        except SceneError as error:
            self._scene_trouble = self._trouble_of(error, schedule)
            log.info("the scene ends at %g s: %s", self._t_ns * 1e-9, error)
            return False
        except _StepInterrupted:
            self._scene_trouble = f"interrupted within the step after {self._t_ns * 1e-9:g} s, which is discarded"
            return False
        finally:
            self._may_interrupt = False
        return True

    def _trouble_of(self, error: SceneError, schedule: Schedule) -> str:
        """Return the reason for the verdict; "" for the regular end of a scene in a run without an end of its own.

        A scene that `stop` ended has no reason either.
        """
        if not isinstance(error, SceneEnded):
            return str(error)
        if schedule.duration_ns is None or self._stopping:
            return ""
        return f"{error} after {self._t_ns * 1e-9:g} of {schedule.duration_ns * 1e-9:g} s"

    @property
    def _goes_on(self) -> bool:
        """True unless the run was stopped, or it has links and all of them are gone."""
        return not self._stopping and (not self._links or any(not link.gone for link in self._links))

    def _locked(self, schedule: Schedule) -> Lockstep | None:
        """Return the lockstep with a bus, where a bus drives the run."""
        if not schedule.lockstep_ns:
            return None
        rings = [setup.timing.syncs for setup in self._setups if setup.timing.syncs is not None]
        if not rings:
            raise ValueError("no link's bus drives this run")
        return Lockstep(rings[0], schedule.lockstep_ns, self._clock)

    def _may_go_on(self, goes_on: Callable[[], bool]) -> bool:
        """Wait for the drive of the run, and report the status meanwhile; return False when the run is to end."""
        if self._drive is None:
            return True
        return self._drive.wait(self._t_ns, goes_on) > self._t_ns

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
            return self._goes_on

        return goes_on

    def _step(self, rule: StepRule, schedule: Schedule, goes_on: Callable[[], bool]) -> None:
        t1_ns = self._t_ns + rule.step_ns
        if isinstance(self._sensor, AdjustableSource):
            t1_ns = min(t1_ns, self._t_ns + self._sensor.longest_step_ns)
        if self._drive is not None:
            t1_ns = min(t1_ns, self._drive.limit_ns)
        if schedule.lockstep_ns:  # steps end with each period, however many SYNCs have come
            t1_ns = min(t1_ns, (self._t_ns // schedule.lockstep_ns + 1) * schedule.lockstep_ns)
        if schedule.duration_ns is not None:
            t1_ns = min(t1_ns, schedule.duration_ns)
        with self._interruptible():
            frame = self._frames.draw(t1_ns)
        self._follow_cameras(schedule, goes_on)
        readings = self._last_readings = self._readings.read(frame)
        if schedule.paced:  # they may leave while the events are computed
            self._hand_over_readings(readings, self._links_of())
        self._cut_off = _cut_off(ledger_of(self._sensor, {}))
        with self._interruptible():
            events = self._sensor.expose(frame)
        self._cut_off = None
        self._step_source.observe(frame)
        t0_ns, self._t_ns = self._t_ns, t1_ns
        self._steps += 1
        self._hand_over_step(StepOutput(events, () if schedule.paced else readings), t0_ns, schedule, self._links_of())
        self._on_events(events)
        if self._second is not None:
            self._hand_over_step(self._second.step(t1_ns), t0_ns, schedule, self._links_of(second=True))

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let `interrupt` act within the block."""
        self._may_interrupt = True
        try:
            yield
        finally:
            self._may_interrupt = False

    def _follow_cameras(self, schedule: Schedule, goes_on: Callable[[], bool]) -> None:
        """Apply to the sensors, at the end of a step, the changes that hosts made at their cameras before it.

        A run that is not paced waits until the cameras are there too, so that no such change is still to come.
        """
        now_us = self._t_ns // 1000
        for link in self._links if not schedule.paced else ():
            link.wait_settled(now_us, goes_on)
        for link in self._links:
            for change in link.take_changes(now_us):
                self._take_change(link.name, change)

    def _take_change(self, link: str, change: CameraSettings | Occurrence) -> None:
        if isinstance(change, Occurrence):
            t_us, fault = change.t_us, change.fault
            self.record(Change(t_us * 1000, change.by, change.what, link, taken_us=t_us, fault=fault))
            return
        self._biases.follow(self._of_first({link: change}), self._t_ns)
        if self._second is not None:
            self._second.follow({link: change}, self._t_ns)

    def _links_of(self, *, second: bool = False) -> list[LinkProcess]:
        """Return the links that carry the first camera, or the second."""
        carried = frozenset() if self._second is None else self._second.links
        return [link for link in self._links if (link.name in carried) == second]

    def _hand_over_step(self, output: StepOutput, t0_ns: int, schedule: Schedule, links: Sequence[LinkProcess]) -> None:
        """Hand over the output of a step from `t0_ns`: in slices where the run waits for room, as rings are finite."""
        if schedule.paced or not any(len(records) for _, records in output.readings):
            self._hand_over_readings(output.readings, links)
            self._hand_over(output.events, schedule, links)
            return
        for until_us in range(t0_ns // 1000 + _SLICE_US, self._t_ns // 1000, _SLICE_US):
            piece, output = output.cut(until_us)
            self._hand_over_readings(piece.readings, links, self._going_on)
            for link in links:
                link.push_all(piece.events, until_us, self._going_on)
        self._hand_over_readings(output.readings, links, self._going_on)
        self._hand_over(output.events, schedule, links)

    def _hand_over_readings(
        self,
        readings: Sequence[tuple[ReadingKind, Readings]],
        links: Sequence[LinkProcess],
        goes_on: Callable[[], bool] | None = None,
    ) -> None:
        for kind, records in readings:
            for link in links:
                link.push_readings(kind, records, goes_on)

    def _hand_over(self, events: Events, schedule: Schedule, links: Sequence[LinkProcess]) -> None:
        now_us = self._t_ns // 1000
        if len(events):  # at the run's end the read-out sends its queue, later than the last step
            now_us = max(now_us, int(events["t"][-1]))
        for link in links:
            if schedule.paced:
                link.push(events, now_us)
            else:
                link.push_all(events, now_us, self._going_on)

    def _going_on(self) -> bool:
        return self._goes_on

    def _status(self, start_ns: int) -> RunStatus:
        reports = {link.name: link.listen() for link in self._links}
        return RunStatus(
            self._t_ns * 1e-9,
            (self._clock.now_ns() - start_ns) * 1e-9,
            self._frames.count,
            self._sensor.read_out,
            self._lateness,
            reports,
            self._sensor.raised,
            self._sensor.lost_in_pixel,
            self._sensor.lost_at_readout,
        )

    def _stop_links(self, drain_s: float) -> dict[str, LinkReport]:
        links, self._links = self._links, []
        reports = {link.name: link.stop(drain_s) for link in links}
        for link in links:
            for change in link.take_changes(_FOREVER_US):
                if isinstance(change, Occurrence):  # settings act on no step any more
                    self._take_change(link.name, change)
        return reports

    def _ledger(self, reports: dict[str, LinkReport]) -> Ledger:
        second = None if self._second is None else self._second.ledger(reports)
        return ledger_of(self._cut_off or self._sensor, self._of_first(reports), second)

    def _of_first(self, of_links: Mapping[str, _T]) -> dict[str, _T]:
        """Return the entries of the links that carry the first camera."""
        carried = frozenset() if self._second is None else self._second.links
        return {name: one for name, one in of_links.items() if name not in carried}


class Operator:
    """Access to a running session for a user; the record of changes contains the user's name.

    Parameters
    ----------
    by : the name.
    """

    def __init__(self, session: Session, by: str) -> None:
        self._session, self._by = session, by

    def stop(self) -> None:
        """End the run after the present step."""
        self._session.stop()

    @property
    def stopping(self) -> bool:
        """True when the run ends after the present step."""
        return self._session.stopping

    @property
    def adjustable(self) -> dict[str, float]:
        """Sensor parameters that can change, with their present values."""
        return self._session.adjustable

    @property
    def changes(self) -> tuple[Change, ...]:
        """Changes from outside so far, in the order in which they came."""
        return self._session.changes

    def adjust(self, name: str, value: float, *, undo: bool = False) -> None:
        """Change a parameter from the next step on; raises ValueError.

        With `undo` the record shows that the value was set back.
        """
        self._session.adjust(name, value, f"{self._by}, undo" if undo else self._by)

    def thresholds_of(self, x: int, y: int) -> tuple[float, float]:
        """Return the ON and OFF threshold of a pixel; raises ValueError where there is none."""
        return self._session.thresholds_of(x, y)

    def inject(self, fault: Fault) -> None:
        """Begin a fault on the link that it names."""
        self._session.inject(fault, self._by)

    def end_fault(self, link: str, number: int) -> None:
        """End the fault with this number on a link."""
        self._session.end_fault(link, number, self._by)

    def happen(self, link: str, kind: EdgeKind | None) -> None:
        """Give the input of a link's camera an edge, or reset its clock."""
        self._session.happen(link, kind, self._by)

    def record(self, t_us: int, what: str) -> None:
        """Record a change of all cameras that acts at a stream time."""
        self._session.record(Change(t_us * 1000, self._by, what))
