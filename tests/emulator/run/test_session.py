"""A run without links: pacing, stopping, and sums, with a clock and a scene that the test holds."""

import dataclasses
import logging
import signal

import numpy as np
import pytest

from emulator.cli.signals import stop_on_signals
from emulator.light import Scene, SceneFrames
from emulator.plan.step_control import FixedSteps
from emulator.run.session import Schedule, Session, StepInterrupted
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
from transports.link.pacing import FakeClock
from transports.link.report import LinkReport

SENSOR = dataclasses.replace(
    PRESETS["davis346"], width=24, height=16, leak_hz=0.0, parasitic_hz_at_reference=0.0, source_follower_hz=0.0,
    noise=NoiseParameters(),
)  # fmt: skip
STEP_NS = 1_000_000


class Flashing(Scene):
    """The whole picture doubles and halves in turn; drawing costs `cost_ns` of the clock."""

    def __init__(self, clock, cost_ns=0, size=(24, 16)):
        self._clock, self._cost_ns, self._size = clock, cost_ns, size
        self.times = []

    @property
    def size(self):
        return self._size

    @property
    def motion_bound_px_s(self):
        return 0.0

    def light(self, t_ns, out):
        self.times.append(t_ns)
        self._clock.advance(self._cost_ns)
        out[:] = 1.0 if t_ns // STEP_NS % 2 else 0.5

    def close(self):
        pass


def session(scene, clock, step_ns=STEP_NS):
    return Session(SceneFrames(scene, with_rate=False), Sensor(SENSOR, 1), FixedSteps(step_ns), [], clock)


def test_a_free_run_draws_each_step_once_and_balances():
    clock = FakeClock()
    scene = Flashing(clock)
    result = session(scene, clock).run(Schedule(duration_ns=20 * STEP_NS, paced=False))
    assert scene.times == [k * STEP_NS for k in range(21)]
    assert (result.steps, result.frames) == (20, 21)
    assert result.sim_seconds == pytest.approx(0.02)
    assert result.ledger.raised > 20 * 24 * 16
    assert result.ledger.balanced


def test_a_paced_run_follows_the_clock():
    clock = FakeClock()
    result = session(Flashing(clock, 10_000), clock).run(Schedule(duration_ns=50 * STEP_NS, lead_ns=2 * STEP_NS))
    assert result.lateness.frames_late == 0
    assert result.wall_seconds == pytest.approx(0.05 + 0.06, abs=0.004)  # the duration and the head start


def test_a_first_step_that_takes_long_is_in_time():
    """Of all steps the first takes longest: caches are cold, and noise has no list of its first events yet."""
    clock = FakeClock()

    class SlowAtFirst(Flashing):
        def light(self, t_ns, out):
            if t_ns == STEP_NS:
                self._clock.advance(30_000_000)
            super().light(t_ns, out)

    result = session(SlowAtFirst(clock), clock).run(Schedule(duration_ns=50 * STEP_NS))
    assert result.lateness.frames_late == 0
    assert result.steps == 50


def test_a_run_has_the_limits_and_the_counts_of_its_lateness():
    clock = FakeClock()

    class LateOnce(Flashing):
        def light(self, t_ns, out):
            if t_ns == 20 * STEP_NS:
                self._clock.advance(5_500_000)  # of a lead of 5 ms
            super().light(t_ns, out)

    run = Schedule(duration_ns=100 * STEP_NS, max_late_us=1000.0, max_late_share=0.01)
    result = session(LateOnce(clock), clock).run(run)
    assert (result.lateness.frames_late, result.late_share, result.too_late) == (1, 0.01, False)
    result = session(LateOnce(clock), clock).run(dataclasses.replace(run, max_late_share=0.0))
    assert (result.step_too_late, result.late_too_often, result.good) == (False, True, False)
    assert session(LateOnce(clock), clock).run(dataclasses.replace(run, max_late_share=0.0, paced=False)).good


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_lateness_has_the_share_of_the_processor_while_steps_were_computed(share):
    class Shared(FakeClock):
        def processor_ns(self):
            return round(share * self.now_ns())

    clock = Shared(1 << 40)
    result = session(Flashing(clock, STEP_NS // 4), clock).run(Schedule(duration_ns=50 * STEP_NS))
    assert result.lateness.processor_share == pytest.approx(share)
    assert result.lateness.computing_ns == pytest.approx(50 * STEP_NS // 4, rel=0.1)


def test_a_slow_scene_makes_a_paced_run_coarser_not_later():
    clock = FakeClock()
    result = session(Flashing(clock, 3 * STEP_NS), clock).run(Schedule(duration_ns=300 * STEP_NS))
    assert result.lateness.steps_stretched > 0
    assert result.steps < 150
    assert result.sim_seconds == pytest.approx(0.3)
    assert result.lateness.worst_gap_us < 20_000


def test_the_last_step_ends_at_the_end():
    clock = FakeClock()
    scene = Flashing(clock)
    session(scene, clock, 700_000).run(Schedule(duration_ns=1_000_000, paced=False))
    assert scene.times == [0, 700_000, 1_000_000]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_inside_a_step_ends_the_run_after_it(number):
    clock = FakeClock()

    class Interrupting(Flashing):
        def light(self, t_ns, out):
            if t_ns == 7 * STEP_NS:
                signal.raise_signal(number)
            super().light(t_ns, out)

    running = session(Interrupting(clock), clock)
    stop_on_signals(running.stop)
    result = running.run(Schedule(paced=False))
    assert result.steps == 7
    assert result.ledger.balanced


def insist(running):
    """Send three signals, as a user does who presses Ctrl-C again and again."""
    stop_on_signals(running.stop, running.interrupt)
    for _ in range(3):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("of", ["light", "sensor"])
def test_signals_within_a_step_end_it_with_a_balanced_ledger(of):
    clock = FakeClock()

    class Insisting(Flashing):
        def light(self, t_ns, out):
            if of == "light" and t_ns == 7 * STEP_NS:
                insist(running)
            super().light(t_ns, out)

    running = session(Insisting(clock), clock)
    expose = running._first.sensor.expose

    def exposed(frame):
        if of == "sensor" and frame.t_ns == 7 * STEP_NS:
            expose(frame)  # its events are discarded
            insist(running)
        return expose(frame)

    running._first.sensor.expose = exposed
    taken = []
    result = running.run(Schedule(paced=False), on_events=taken.append)
    assert result.steps == 6
    assert "interrupted within the step after 0.006 s" in result.scene_trouble
    assert result.ledger.balanced
    assert result.ledger.read_out == sum(map(len, taken)) > 0


def test_a_step_that_is_ended_while_its_pixels_are_computed_is_discarded_and_the_next_run_is_whole(caplog):
    caplog.set_level(logging.INFO)
    clock, taken = FakeClock(), []

    class Ending(Flashing):
        def light(self, t_ns, out):
            super().light(t_ns, out)
            if t_ns == 7 * STEP_NS:
                running.end_step()

    running = session(Ending(clock), clock)
    running.end_step()  # before the run: of no effect
    result = running.run(Schedule(paced=False), on_events=taken.append)
    assert result.steps == 6
    assert "interrupted within the step after 0.006 s" in caplog.text
    assert result.good
    assert result.ledger.balanced
    assert result.ledger.read_out == sum(map(len, taken)) > 0
    running.end_step()  # after it, too
    assert session(Flashing(clock), clock).run(Schedule(duration_ns=20 * STEP_NS, paced=False)).steps == 20


def test_signals_while_events_are_handed_over_lose_none():
    clock, taken = FakeClock(), []
    running = session(Flashing(clock), clock)

    def take(events):
        taken.append(events)
        if len(taken) == 5:
            insist(running)

    result = running.run(Schedule(paced=False), on_events=take)
    assert result.ledger.balanced
    assert result.ledger.read_out == sum(map(len, taken)) > 0
    assert (result.steps, result.scene_trouble) == (5, "")


def test_a_step_is_no_longer_than_its_work_allows():
    clock = FakeClock()
    scene = Flashing(clock)
    running = session(scene, clock)
    running._first.sensor.longest_step_ns = STEP_NS // 4
    running.run(Schedule(duration_ns=2 * STEP_NS, paced=False))
    assert scene.times == [k * STEP_NS // 4 for k in range(9)]


def test_a_run_can_be_stopped_from_its_status():
    clock = FakeClock()
    running = session(Flashing(clock, STEP_NS), clock)
    seen = []

    def stop_after_two(status):
        seen.append(status)
        if len(seen) == 2:
            running.stop()

    result = running.run(Schedule(paced=False), stop_after_two)
    assert len(seen) == 2
    assert seen[1].read_out > 0
    assert result.steps < 200


def test_events_do_not_depend_on_the_pace():
    clock = FakeClock()
    counts = {
        paced: session(Flashing(clock), clock).run(Schedule(duration_ns=30 * STEP_NS, paced=paced)).ledger
        for paced in (True, False)
    }
    assert counts[True] == counts[False]


def test_light_that_is_not_a_number_is_dark_for_the_ledger_too():
    clock = FakeClock()

    class Broken(Flashing):
        def light(self, t_ns, out):
            super().light(t_ns, out)
            out[:, ::2] = np.nan

    result = session(Broken(clock), clock).run(Schedule(duration_ns=10 * STEP_NS, paced=False))
    whole = session(Flashing(clock), clock).run(Schedule(duration_ns=10 * STEP_NS, paced=False))
    assert result.ledger.balanced
    assert 0 < result.ledger.raised < whole.ledger.raised


def test_frames_too_far_apart_show_as_undersampled():
    sensor = dataclasses.replace(SENSOR, width=64, height=48)
    board = CheckerboardParameters(square_px=8.0, speed_px_s=100.0)

    def share(step_ns):
        with Checkerboard(board, (64, 48)) as scene:
            frames = SceneFrames(scene, with_rate=True)
            running = Session(frames, Sensor(sensor, 1), FixedSteps(step_ns), [], FakeClock())
            return running.run(Schedule(duration_ns=100 * STEP_NS, paced=False)).undersampled_share

    close, apart = share(100_000), share(20_000_000)
    assert close < 0.05
    assert apart > 0.5


def test_a_link_that_found_fault_makes_the_run_bad():
    clock = FakeClock()
    result = session(Flashing(clock), clock).run(Schedule(duration_ns=2 * STEP_NS, paced=False))
    assert result.good
    assert not dataclasses.replace(result, links={"loopback": LinkReport("closed", error="others received")}).good


def test_a_scene_of_another_size_is_refused():
    clock = FakeClock()
    with pytest.raises(ValueError, match="the scene is"):
        session(Flashing(clock, size=(24, 24)), clock)


def test_an_interrupt_within_a_kernel_ends_the_step():
    """Numba raises SystemError in its place; others stay."""
    session = Session.__new__(Session)
    with pytest.raises(StepInterrupted), session._interruptible():
        raise SystemError("returned a result with an exception set") from StepInterrupted()
    with pytest.raises(SystemError), session._interruptible():
        raise SystemError("another one")
