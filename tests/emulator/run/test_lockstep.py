"""A run that a bus drives: time goes as far as the SYNCs let it, and stops when they do."""

import dataclasses
import threading
from functools import partial

import pytest

from emulator.light import Scene, SceneFrames
from emulator.plan.step_control import FixedSteps
from emulator.rig.tables import Trigger
from emulator.run.assembly import TriggerPaths
from emulator.run.pacing import Lockstep
from emulator.run.session import Schedule, Session
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.events import EdgeKind
from tests.npz_records import load_edges
from transports.link.edges import EdgeRing, EdgeSink, EdgeTiming
from transports.link.endpoint import LinkFactory
from transports.link.pacing import FakeClock, MonotonicClock
from transports.link.process import LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing
from transports.recording.live import FileRecorder
from transports.usb.kind import LoopbackLink
from transports.usb.loopback import LoopbackEndpoint

LOOPBACK = LinkFactory(LoopbackEndpoint, LoopbackLink())

PERIOD_NS = 10_000_000
SENSOR = dataclasses.replace(
    PRESETS["davis346"], width=24, height=16, leak_hz=0.0, parasitic_hz_at_reference=0.0, source_follower_hz=0.0,
    noise=NoiseParameters(),
)  # fmt: skip


class Flashing(Scene):
    """The whole picture doubles and halves in turn."""

    size = (24, 16)
    motion_bound_px_s = 0.0

    def light(self, t_ns, out):
        out[:] = 1.0 if t_ns // 1_000_000 % 2 else 0.5

    def close(self):
        pass


def session(setups, clock, step_ns=3_000_000):
    return Session(SceneFrames(Flashing(), with_rate=False), Sensor(SENSOR, 1), FixedSteps(step_ns), setups, clock)


class SyncingClock(FakeClock):
    """A clock on which a SYNC is heard at each sleep."""

    def __init__(self, sink, most):
        super().__init__()
        self._sink, self._left = sink, most

    def sleep_until(self, deadline_ns):
        super().sleep_until(deadline_ns)
        if self._left:
            self._left -= 1
            self._sink(self.now_ns(), 0)


def ring_and_sink():
    run, ring = EventRing(16), EdgeRing()
    run.start(FREE_RUNNING)
    return ring, EdgeSink([ring], run, EdgeTiming(), PERIOD_NS // 1000)


def test_each_sync_is_worth_one_period():
    ring, sink = ring_and_sink()
    lockstep = Lockstep(ring, PERIOD_NS, SyncingClock(sink, 3))
    assert lockstep.limit_ns == 0
    assert lockstep.wait(0, lambda: True) == PERIOD_NS
    assert lockstep.wait(PERIOD_NS - 1, lambda: True) == PERIOD_NS
    assert lockstep.wait(2 * PERIOD_NS, lambda: True) == 3 * PERIOD_NS
    assert lockstep.received == 3


def test_waiting_ends_when_the_run_does():
    ring, sink = ring_and_sink()
    asked = []
    lockstep = Lockstep(ring, PERIOD_NS, SyncingClock(sink, 0))
    assert lockstep.wait(0, lambda: asked.append(1) or len(asked) < 5) == 0


def test_a_run_without_a_bus_cannot_be_in_lockstep():
    with pytest.raises(ValueError, match="no link's bus"):
        session([], FakeClock()).run(Schedule(paced=False, lockstep_ns=PERIOD_NS))


def driven(tmp_path, syncs, *, ends_by_itself):
    """A whole run with a real link; a thread is the bus. Returns its result and its edges."""
    clock = MonotonicClock()
    paths = TriggerPaths(Trigger(source="bus", kind="rising", latency_us=7), ["bus"], 1, PERIOD_NS // 1000)
    events = EventRing()
    camera = partial(Davis346, Davis346Settings(size=(24, 16), start_delay_us=0))
    timing = paths.timing("bus", None, None)
    setup = LinkSetup("bus", events, camera, LOOPBACK, FileRecorder(tmp_path / "a.npz"), timing=timing)
    run = session([setup], clock)
    sink = paths.sink("bus", events)

    def bus():
        while events.origin_ns is None:
            clock.sleep_until(clock.now_ns() + 1_000_000)
        for k in range(syncs):
            sink(clock.now_ns(), k)
            clock.sleep_until(clock.now_ns() + 2_000_000)
        while not ends_by_itself and events.now_us < syncs * PERIOD_NS // 1000:
            clock.sleep_until(clock.now_ns() + 1_000_000)
        if not ends_by_itself:
            run.stop()

    heard = threading.Thread(target=bus)
    heard.start()
    duration_ns = syncs * PERIOD_NS if ends_by_itself else None
    result = run.run(Schedule(duration_ns=duration_ns, paced=False, lockstep_ns=PERIOD_NS))
    heard.join()
    return result, load_edges(tmp_path / "a.npz")[0]


@pytest.mark.parametrize("ends_by_itself", [True, False])
def test_a_driven_run_ends_where_its_syncs_do_and_its_edges_are_at_their_numbers(tmp_path, ends_by_itself):
    result, edges = driven(tmp_path, 10, ends_by_itself=ends_by_itself)
    assert result.good
    assert result.syncs == 10
    assert result.sim_seconds == pytest.approx(0.1)
    assert edges[edges["kind"] == EdgeKind.RISING]["t"].tolist() == [7 + k * 10_000 for k in range(10)]
