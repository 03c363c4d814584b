"""Faults of a DAVIS346's words: what a sound receiver makes of them, and what the fault says that it destroyed."""

import numpy as np
import pytest

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.events import EVENT
from tests.made_events import events_at
from transports.faults.faulty_device import FaultyDevice
from transports.faults.script import FaultPlan
from transports.faults.usb import FifoOverflow, RegisterFlip, WrongVersion
from transports.faults.words import MissedWraps, OddBytes, RepeatedEvents, StaleData, TimeAhead, TimeBack, TimeFrozen
from transports.usb.davis_host import DavisHost
from transports.usb.host import StreamSettings
from transports.usb.loopback import DirectHost

WRAP_US = 32_768
STEP_US = 20_000


def unique_events(count=3000, spacing_us=100):
    """Events of which no two have the same place, so that each can be told from the others whatever its time."""
    rng = np.random.default_rng(3)
    places = rng.permutation(346 * 260)[:count]
    return events_at(
        1000 + np.cumsum(rng.integers(1, 2 * spacing_us, count)),
        x=places % 346,
        y=places // 346,
        on=rng.integers(0, 2, count),
    )


class Bench:
    """A camera behind faults, its driver, and the events that the faults let through."""

    def __init__(self, seed=1, **settings):
        self.model = Davis346(Davis346Settings(start_delay_us=0, **settings))
        self.faulty = FaultyDevice(self.model, FaultPlan("usb", seed=seed))
        self.through, self.decoded, self.decoder = [np.zeros(0, EVENT)], [np.zeros(0, EVENT)], Decoder()
        self.camera = DavisHost(DirectHost(self.faulty))

    def start(self):
        self.camera.start(StreamSettings(reset_timestamps=False))
        return self

    def take(self, max_bytes=4096):
        while (transfer := self.faulty.read(2, max_bytes)) is not None:
            assert len(transfer.data) <= max_bytes
            self.faulty.sent(transfer)
            survivors = transfer.events.copy()
            survivors["t"] -= np.uint64(transfer.epoch_us)
            self.through.append(survivors)
            self.decoded.append(self.decoder.feed(transfer.data[: len(transfer.data) & ~1]).events)

    def run(self, events, fault=None, at_us=0, max_bytes=4096):
        """Send `events` in steps of stream time, injecting `fault` at `at_us`."""
        for now_us in range(STEP_US, int(events["t"][-1]) + 2 * STEP_US, STEP_US):
            if fault is not None and now_us > at_us:
                self.faulty.inject(fault)
                fault = None
            self.model.offer(events[(events["t"] > now_us - STEP_US) & (events["t"] <= now_us)])
            self.model.advance(now_us)
            self.faulty.advance(now_us)
            self.take(max_bytes)
        return np.concatenate(self.decoded), np.concatenate(self.through)


CASES = {
    "odd byte missing": OddBytes(rate=0.2, count=5),
    "odd byte more": OddBytes(rate=0.2, count=5, change="extra"),
    "repeated": RepeatedEvents(rate=0.1, count=100),
    "missed wrap": MissedWraps(count=1),
    "ahead": TimeAhead(wraps=2),
    "back": TimeBack(by_us=900, for_s=0.1),
    "frozen": TimeFrozen(for_s=0.1),
}


@pytest.mark.parametrize("max_bytes", [64, 4096, 131_072])
@pytest.mark.parametrize("name", CASES)
def test_what_the_fault_lets_through_is_what_a_sound_receiver_has(name, max_bytes):
    sent, bench = unique_events(), Bench().start()
    decoded, through = bench.run(sent, CASES[name], 100_000, max_bytes)
    assert np.array_equal(through, sent[np.isin(sent, decoded)])
    (record,) = bench.faulty.records
    assert record.hits > 0
    assert record.events_lost == len(sent) - len(through)
    assert bench.model.counters.delivered == len(sent) == bench.model.counters.accounted


@pytest.mark.parametrize("name", ["odd byte more", "repeated"])
def test_what_only_adds_destroys_nothing(name):
    sent, bench = unique_events(), Bench().start()
    decoded, through = bench.run(sent, CASES[name], 100_000)
    assert np.array_equal(through, sent)
    assert len(decoded) == len(sent) + (100 if name == "repeated" else 0)


def test_a_missed_wrap_puts_all_later_times_back_by_one_step():
    sent, bench = unique_events(), Bench().start()
    decoded, through = bench.run(sent, MissedWraps(count=1), 100_000)
    late = decoded["t"] != sent["t"]
    assert np.all(sent["t"][late] - decoded["t"][late] == WRAP_US)
    assert np.all(late[np.argmax(late) :])
    assert len(through) == np.count_nonzero(~late)


def test_time_ahead_lasts_until_the_timestamp_reset():
    sent, bench = unique_events(), Bench().start()
    decoded, _ = bench.run(sent, TimeAhead(wraps=3), 100_000)
    assert decoded["t"][-1] - sent["t"][-1] == 3 * WRAP_US
    bench.camera.write_registers([(0, 2, 1), (0, 2, 0)])
    before = len(np.concatenate(bench.through))
    more = unique_events(100)
    more["t"] += bench.model.now_us
    bench.model.offer(more)
    bench.take()
    assert len(np.concatenate(bench.through)) == before + 100


def test_a_stream_that_is_started_anew_is_read_by_a_receiver_that_knows_nothing():
    sent, bench = unique_events(), Bench().start()
    bench.run(sent, TimeAhead(wraps=3), 100_000)
    bench.camera.stop()
    bench.start()
    before, begun_us, more = sum(map(len, bench.through)), bench.model.now_us, unique_events(100)
    more["t"] += begun_us
    bench.model.offer(more)
    bench.take()
    assert sum(map(len, bench.through)) == before + 100


def test_a_frozen_clock_is_right_again_afterwards():
    sent, bench = unique_events(), Bench().start()
    decoded, _ = bench.run(sent, TimeFrozen(for_s=0.1), 100_000)
    wrong = np.flatnonzero(decoded["t"] != sent["t"])
    frozen = decoded["t"][wrong]
    assert frozen[0] == frozen[-1]
    assert sent["t"][wrong[-1]] - sent["t"][wrong[0]] > 100_000 - 2 * STEP_US - 1000
    assert np.array_equal(decoded[wrong[-1] + 1 :], sent[wrong[-1] + 1 :])


def test_time_goes_back_by_what_was_asked_and_never_below_the_wrap():
    sent, bench = unique_events(), Bench().start()
    decoded, _ = bench.run(sent, TimeBack(by_us=900, for_s=0.1), 100_000)
    wrong = decoded["t"] != sent["t"]
    assert (sent["t"] - decoded["t"])[wrong].max() == 900
    assert np.array_equal(decoded["t"][wrong] // WRAP_US, sent["t"][wrong] // WRAP_US)
    assert decoded["t"][wrong].min() >= 65_536


def test_stale_data_come_first_at_the_next_start():
    bench = Bench()
    bench.faulty.inject(StaleData(events=40))
    bench.start()
    sent = unique_events(500)
    decoded, through = bench.run(sent)
    assert len(decoded) == 540
    assert len(through) == np.count_nonzero(np.isin(sent, decoded))
    assert [(r.hits, r.touched) for r in bench.faulty.records] == [(1, 120)]


def test_the_same_seed_hits_the_same_words():
    sent = unique_events()
    runs = [Bench(seed).start().run(sent, CASES["repeated"], 100_000)[0] for seed in (1, 1, 2)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_an_overflow_ends_when_the_camera_has_dropped():
    bench = Bench(fifo_bytes=1024).start()
    sent = unique_events()
    _, through = bench.run(sent, FifoOverflow(events=50), 100_000)
    (record,) = bench.faulty.records
    dropped = bench.model.counters.dropped_fifo
    assert dropped >= 50
    assert record.ended_us is not None
    assert len(through) == len(sent) - dropped
    assert record.events_lost == 0  # the camera knows of them


def test_a_flip_of_the_run_bit_stops_events_until_it_is_written_again():
    bench = Bench().start()
    bench.faulty.inject(RegisterFlip(module=1, parameter=3, bit=0))
    assert bench.camera.read_register(1, 3) == 0
    assert not bench.model.streaming
    bench.camera.write_register(1, 3, 1)
    assert bench.model.streaming
    bench.faulty.advance(1)
    assert [(r.hits, r.ended_us) for r in bench.faulty.records] == [(1, 1)]


def test_a_flip_of_a_register_that_only_reads_shows_until_power_on():
    bench = Bench()
    bench.faulty.inject(RegisterFlip(module=6, parameter=0, bit=1))
    assert bench.camera.read_register(6, 0) == 18 ^ 2
    bench.faulty.attached()
    assert bench.camera.read_register(6, 0) == 18


def test_wrong_versions_are_told_while_the_fault_lasts():
    bench = Bench()
    bench.faulty.inject(WrongVersion(firmware=7, logic_version=17, logic_patch=0, for_s=1.0))
    assert bench.faulty.identity.bcd_device == 0x0207
    assert [bench.camera.read_register(6, k) for k in (0, 7, 1)] == [17, 0, 5]
    bench.faulty.advance(1_000_000)
    assert bench.faulty.identity.bcd_device == 0x0206
    assert bench.camera.read_register(6, 0) == 18


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: TimeBack(by_us=0), "by_us"),
        (lambda: TimeAhead(wraps=0), "wraps"),
        (lambda: StaleData(events=0), "events"),
        (lambda: RegisterFlip(bit=32), "bit"),
        (lambda: RegisterFlip(module=-1), "module"),
        (lambda: WrongVersion(firmware=256), "firmware"),
        (lambda: WrongVersion(chip=-2), "chip"),
        (lambda: FifoOverflow(events=0), "events"),
    ],
)
def test_bad_keys_are_named(make, says):
    with pytest.raises(ValueError, match=says):
        make()
