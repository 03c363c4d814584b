"""Biases that hosts write while a run goes on: they act at stated stream times, whatever the machine does meanwhile."""

import dataclasses
import random
import threading
import time
from functools import partial

import numpy as np
import pytest

from emulator.light import Scene, SceneFrames
from emulator.plan.step_control import FixedSteps
from emulator.rig.tables import Trigger
from emulator.run.assembly import TriggerPaths
from emulator.run.camera import CameraView, ReadingSources
from emulator.run.changes import Change, Changes
from emulator.run.session import Schedule, Session
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
from firmware_protocol.davis346.biases import BIASES, CoarseFine
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.events import EdgeKind
from firmware_protocol.fx3.registers import Module
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.packets.ccsds import Acknowledge
from firmware_protocol.packets.profile import ReceivedCommand
from firmware_protocol.packets.telecommands import RequestId, SetBias, SetRegion
from firmware_protocol.usb.device import SetupPacket
from transports.faults.kinds import Fault
from transports.faults.script import FaultPlan, Faulty
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.link.loop import Happen, InjectFault
from transports.link.pacing import MonotonicClock
from transports.link.process import LinkSetup
from transports.link.rings import EventRing

MS = 1_000_000
SIZE = (24, 16)
SENSOR = dataclasses.replace(
    PRESETS["davis346"], width=24, height=16, noise=NoiseParameters(rms=0.08), leak_hz=0.5, refractory_us=500.0
)
NUMBERS = {bias.name: bias.address for bias in BIASES}
HIGHER, LOWER = int(CoarseFine(6, 200)), int(CoarseFine(5, 60))
SCRIPT = ((7_300, "OnBn", LOWER), (15_000, "OffBn", int(CoarseFine(3, 90))), (31_999, "OnBn", HIGHER))


@dataclasses.dataclass(frozen=True)
class ScriptedFault(Fault):
    carriers = ("a script",)


class FaultyScript(Faulty):
    carrier = "a script"


class ScriptedHost(Endpoint):
    """Writes each bias as soon as its camera's clock has reached a time; takes no events."""

    def __init__(self, device, script, most_writes=100):
        self._device, self._script, self._most_writes = device, list(script), most_writes
        self.faulty = FaultyScript(FaultPlan("usbip"))

    async def start(self):
        if isinstance(self._device, Davis346):
            self._device.attached()

    def listen(self):
        for _ in range(self._most_writes):
            if self._script and self._device.now_us >= self._script[0][0]:
                self._set(*self._script.pop(0)[1:])

    def _set(self, name, value):
        if isinstance(self._device, Davis346):
            setup = SetupPacket(0x40, 0xBF, Module.BIAS, NUMBERS[name], 4)
            self._device.control(setup, value.to_bytes(4, "big"))
            return
        command = SetRegion(0, 0, 8, 8) if name == "region" else SetBias(NUMBERS[name], value)
        self._device.command(ReceivedCommand(RequestId(0, 0), Acknowledge(0), command))

    def pump(self):
        pass

    async def close(self):
        pass

    @property
    def state(self):
        return "open"


@dataclasses.dataclass(frozen=True)
class ScriptedFactory(EndpointFactory):
    script: tuple
    most_writes: int = 100

    def build(self, device, deliveries):
        return ScriptedHost(device, self.script, self.most_writes)


class Flicker(Scene):
    """The whole picture doubles and halves every 8 ms; drawing takes up to `delay_s` of the machine's time."""

    size = SIZE
    motion_bound_px_s = 0.0

    def __init__(self, delay_s=0.0):
        self._delay_s, self._random = delay_s, random.Random(1)

    def light(self, t_ns, out):
        time.sleep(self._delay_s * self._random.random())
        out[:] = 0.5 if t_ns // (8 * MS) % 2 else 0.25

    def close(self):
        pass


def link(name="usbip", script=SCRIPT, device=Davis346, most_writes=100, **more):
    make = partial(Davis346, Davis346Settings(size=SIZE)) if device is Davis346 else partial(Instrument, SIZE)
    return LinkSetup(name, EventRing(), make, ScriptedFactory(script, most_writes), **more)


class ListedSteps:
    """Steps that end at given stream times."""

    def __init__(self, ends_ns):
        self._ends_ns = ends_ns

    def observe(self, frame):
        self.step_ns = next((end - frame.t_ns for end in self._ends_ns if end > frame.t_ns), 1)


def session(setups, delay_s=0.0, steps=None):
    frames = SceneFrames(Flicker(delay_s), with_rate=False)
    return Session(frames, Sensor(SENSOR, 1), steps or FixedSteps(MS), setups, MonotonicClock())


def events_of(running, schedule, **more):
    """Return the events of a run, its result, and when its steps ended, ns."""
    found, ends_ns = [], []

    def take(events):
        found.append(events)
        ends_ns.append(running.t_ns)

    result = running.run(schedule, on_events=take, **more)
    return np.concatenate(found), result, ends_ns


def repeated(changes, ends_ns):
    """The events of a run without links, in which a program changes the same figures at the same stream times."""
    running, found, left = session([], steps=ListedSteps(ends_ns)), [], list(changes)

    def take(events):
        found.append(events)
        while left and left[0].t_ns <= running.t_ns:
            running.adjust(left[0].what, left.pop(0).after)

    running.run(Schedule(duration_ns=ends_ns[-1], paced=False), on_events=take)
    return np.concatenate(found)


FREE = Schedule(duration_ns=50 * MS, paced=False, drain_s=0.1)
PACED = Schedule(duration_ns=100 * MS, lead_ns=6 * MS, drain_s=0.1)
MACHINES = {"quick": (100, 0.0), "slow link": (4000, 0.0), "slow scene": (300, 0.004), "both": (2500, 0.003)}


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("step_ns", [MS, 2_500_000])
def test_a_free_run_has_the_same_events_on_any_machine(step_ns):
    runs = {}
    for name, (tick_us, delay_s) in MACHINES.items():
        runs[name] = events_of(session([link(tick_us=tick_us)], delay_s, FixedSteps(step_ns)), FREE)
    events, result, ends_ns = runs["quick"]
    assert [one.what for one in result.changes] == ["threshold_on", "threshold_off", "threshold_on"]
    assert {(one.by, one.link) for one in result.changes} == {("register", "usbip")}
    for change, (at_us, _, _) in zip(result.changes, SCRIPT, strict=True):
        taken_ns = change.taken_us * 1000
        assert at_us * 1000 <= taken_ns < at_us * 1000 + step_ns
        assert change.t_ns == (taken_ns // step_ns + 1) * step_ns  # the end of the step in which it was taken
        assert change.before != change.after
    for others, of_others, _ in runs.values():
        assert of_others.changes == result.changes
        assert np.array_equal(others, events)
    assert len(events) > 1000
    assert np.array_equal(events, repeated(result.changes, ends_ns))


@pytest.mark.long
@pytest.mark.system
def test_a_run_in_lockstep_has_the_same_events_on_any_machine():
    period_ns, syncs = 10 * MS, 5
    runs = []
    for tick_us, delay_s in MACHINES.values():
        paths = TriggerPaths(Trigger(source="bus", kind="rising"), ["bus"], 1, period_ns // 1000)
        setup = link("bus", timing=paths.timing("bus", None, None), tick_us=tick_us)
        sink = paths.sink("bus", setup.ring)

        def bus(ring=setup.ring, sink=sink, delay_s=delay_s):
            while ring.origin_ns is None:
                time.sleep(0.001)
            for number in range(syncs):
                sink(time.monotonic_ns(), number)
                time.sleep(2 * delay_s)

        thread = threading.Thread(target=bus)
        thread.start()
        lockstep = dataclasses.replace(FREE, lockstep_ns=period_ns, duration_ns=syncs * period_ns)
        runs.append(events_of(session([setup], delay_s, FixedSteps(3 * MS)), lockstep))
        thread.join()
    (events, result, _), *others = runs
    assert [one.t_ns for one in result.changes] == [10 * MS, 19 * MS, 36 * MS]  # taken at 9, 16 and 33; steps end there
    for other, of_other, _ in others:
        assert of_other.changes == result.changes
        assert np.array_equal(other, events)


@pytest.mark.system
def test_a_paced_run_can_be_repeated_from_its_record():
    """Steps are computed ahead of the camera there: a bias acts from the first one on that is not."""
    events, result, ends_ns = events_of(session([link()]), PACED)
    assert len(result.changes) == 3
    for change in result.changes:
        assert change.t_ns > change.taken_us * 1000
        assert change.t_ns in ends_ns
    assert np.array_equal(events, repeated(result.changes, ends_ns))


@pytest.mark.system
@pytest.mark.parametrize("schedule", [FREE, PACED], ids=["free", "paced"])
def test_a_register_between_two_writes_acts_on_no_step(schedule):
    """The host of this link writes one register a tick, so that the camera's time may move between two of them."""
    lowest, default = int(CoarseFine(4, 60)), int(CoarseFine(5, 255))
    opening = [(20_000, "OnBn", lowest), (20_000, "OffBn", lowest), (20_000, "OnBn", HIGHER)]
    again = [(35_000, "OnBn", lowest), (35_000, "OnBn", default), (35_000, "OnBn", HIGHER)]
    running = session([link(script=(*opening, *again), most_writes=1)])
    events, result, ends_ns = events_of(running, schedule)
    assert [change.what for change in result.changes] == ["threshold_off", "threshold_on"]
    assert all(20_000 <= change.taken_us < 35_000 for change in result.changes)
    assert len({change.t_ns for change in result.changes}) == 1
    assert np.array_equal(events, repeated(result.changes, ends_ns))


@pytest.mark.system
def test_telecommands_and_several_links_are_recorded_with_their_links():
    commands = link("serial", ((9_000, "region", 0), (20_500, "OnBn", LOWER)), Instrument)
    _, result, _ = events_of(session([link(), commands]), FREE)
    by_link = {name: [one for one in result.changes if one.link == name] for name in ("usbip", "serial")}
    assert len(by_link["usbip"]) == 3
    region, bias, threshold = by_link["serial"]
    assert (region.what, region.by) == ("SetRegion(x=0, y=0, width=8, height=8)", "telecommand")
    assert region.t_ns == region.taken_us * 1000 == 9 * MS
    assert bias.what == f"SetBias(bias={NUMBERS['OnBn']}, value={LOWER})"
    assert (threshold.what, threshold.by, threshold.t_ns) == ("threshold_on", "telecommand", 22 * MS)
    assert [one.t_ns for one in result.changes] == sorted(one.t_ns for one in result.changes)


@pytest.mark.long
@pytest.mark.system
def test_the_second_camera_follows_its_own_host_at_stated_times():
    def run(tick_us, delay_s):
        running = session([link("left", SCRIPT[:1]), link("right", SCRIPT[1:], tick_us=tick_us)], delay_s)
        sensor, scene = Sensor(SENSOR, 2), SceneFrames(Flicker(), with_rate=False)
        running.join(CameraView(scene, sensor, ReadingSources((), ()), ["right"]))
        return *events_of(running, FREE), sensor

    (events, result, ends_ns, second), *others = (run(*machine) for machine in MACHINES.values())
    assert [(one.link, one.what) for one in result.changes] == [
        ("left", "threshold_on"), ("right", "threshold_off"), ("right", "threshold_on"),
    ]  # fmt: skip
    assert second.adjustable["threshold_off"] == result.changes[1].after
    assert np.array_equal(events, repeated(result.changes[:1], ends_ns))
    for other, of_other, _, sensor in others:
        assert of_other.changes == result.changes
        assert np.array_equal(other, events)
        assert (sensor.raised, sensor.read_out) == (second.raised, second.read_out)


@pytest.mark.system
def test_faults_and_edges_by_hand_are_recorded_with_the_time_of_the_camera():
    running = session([link(script=())])

    def once(status):
        if not done and running.t_ns:
            done.append(running.t_ns)
            running.order("usbip", InjectFault(ScriptedFault(link="usbip"), "evstim"))
            running.order("usbip", Happen(EdgeKind.RISING, "evstim"))

    done = []
    _, result, _ = events_of(running, dataclasses.replace(FREE, drain_s=5.0), on_status=once)
    fault, edge = result.changes
    assert (fault.by, fault.link, fault.what.split()[0]) == ("evstim", "usbip", "fault")
    assert (edge.by, edge.link, edge.what) == ("evstim", "usbip", "trigger rising")
    assert fault.taken_us * 1000 == fault.t_ns <= 50 * MS


def test_what_a_program_changes_is_recorded():
    running = session([])
    values = iter([0.5, 0.4])

    def take(events):
        if running.t_ns in (3 * MS, 8 * MS):
            running.adjust("threshold_on", next(values))

    result = running.run(FREE, on_events=take)
    assert result.changes == (
        Change(3 * MS, "program", "threshold_on", before=SENSOR.threshold_on, after=0.5),
        Change(8 * MS, "program", "threshold_on", before=0.5, after=0.4),
    )


def test_a_record_of_changes_has_a_bound():
    changes = Changes()
    for k in range(10_007):
        changes.add(Change(-k, "register", "threshold_on"))
    assert len(changes.listed) == 10_000
    assert changes.beyond == 7
    assert changes.listed[0].t_ns == -9_999
