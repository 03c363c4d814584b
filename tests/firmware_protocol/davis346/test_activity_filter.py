"""Background activity and refractory filter: hand-made cases, a reference in plain Python, and cuts into batches."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.registers import Layout
from firmware_protocol.events import EVENT
from tests.made_events import scattered
from transports.usb.davis_host import DavisHost
from transports.usb.host import StreamSettings
from transports.usb.loopback import DirectHost

HAS, BACKGROUND, BACKGROUND_TIME, REFRACTORY, REFRACTORY_TIME = 30, 31, 32, 33, 34
BACKGROUND_COUNT, REFRACTORY_COUNT = (1, 90), (1, 92)
WRAP_US = (1 << 18) * 250


class Reference:
    """The rule pixel by pixel: each pixel looks at the pixels around it and takes the stamps of their cells."""

    def __init__(self, width=346, height=260):
        self.size, self.stamps, self.since_us = (width, height), {}, 0
        self.written = {BACKGROUND: 0, BACKGROUND_TIME: 8, REFRACTORY: 0, REFRACTORY_TIME: 1}
        self.isolated = self.too_soon = 0

    def write(self, written, now_us):
        was_on = self.written[BACKGROUND] or self.written[REFRACTORY]
        self.written.update(written)
        if not was_on:
            self.since_us = now_us

    def _age(self, x, y, tick):
        return (tick - self.stamps.get((x // 4, y // 4), 0)) % (1 << 18)

    def passes(self, t, x, y):
        background, age, refractory, pause = (self.written[k] for k in range(31, 35))
        if not background and not refractory:
            return True
        tick = (t - self.since_us) // 250 % (1 << 18)
        around = [(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        on_map = [p for p in around if p[0] // 4 in range(-(-self.size[0] // 4)) and 0 <= p[1] // 4 < self.size[1] / 4]
        supported = any(self._age(*p, tick) <= age for p in on_map)
        too_soon = refractory and self._age(x, y, tick) < pause
        isolated = background and not too_soon and not supported
        self.stamps[x // 4, y // 4] = tick
        self.too_soon, self.isolated = self.too_soon + bool(too_soon), self.isolated + bool(isolated)
        return not too_soon and not isolated


class Bench:
    def __init__(self, layout=Layout.UPRIGHT, size=(346, 260)):
        settings = Davis346Settings(start_delay_us=0, layout=layout, size=size, activity_filter=True)
        self.model = Davis346(settings)
        self.camera = DavisHost(DirectHost(self.model))
        self.camera.start(StreamSettings(reset_timestamps=False))

    def write(self, written):
        self.camera.write_registers([(1, address, value) for address, value in written.items()])

    def show(self, *parts):
        """Offer the parts, and return as stream time's events what was sent."""
        received = [np.zeros(0, EVENT)]
        for part in parts:
            self.model.offer(part)
            while (some := self.camera.read(0.0)) is not None:
                received.append(some)
        return np.concatenate(received)


def events_at(*places):
    return np.array([(t, x, y, True) for t, x, y in places], EVENT)


def some_events(count=4000, seed=1, start_us=5000, step_us=150, size=(40, 30), corner=(0, 0)):
    steps = np.random.default_rng(seed).integers(0, 2 * step_us, count)
    events = scattered(start_us + np.cumsum(steps), size, seed)
    events["x"] += corner[0]
    events["y"] += corner[1]
    return events


def test_all_passes_while_the_stamps_are_as_the_power_left_them():
    bench = Bench()
    bench.write({BACKGROUND: 1})
    assert bench.show(events_at((2249, 9, 9), (2250, 99, 99)))["t"].tolist() == [2249]


def test_a_stamp_looks_new_again_when_the_clock_has_wrapped():
    bench = Bench()
    bench.write({BACKGROUND: 1})
    assert not len(bench.show(events_at((10_000, 9, 9))))
    bench.model.advance(WRAP_US)
    assert bench.show(events_at((WRAP_US + 12_000, 9, 9)))["t"].tolist() == [WRAP_US + 12_000]


def test_the_clock_starts_when_the_first_filter_is_switched_on():
    sent = events_at((20_000, 9, 9), (20_249, 9, 9))
    bench = Bench()
    bench.model.advance(15_100)
    bench.write({REFRACTORY: 1})
    bench.write(
        {BACKGROUND: 1}
    )  # 20 000 is at 4900: ticks 19 and 20, although the events are of one 250 us of the host
    assert len(bench.show(sent)) == 1


ASKED = {
    "background": {BACKGROUND: 1},
    "background, short": {BACKGROUND: 1, BACKGROUND_TIME: 0},
    "refractory": {REFRACTORY: 1, REFRACTORY_TIME: 40},
    "both": {BACKGROUND: 1, BACKGROUND_TIME: 12, REFRACTORY: 1, REFRACTORY_TIME: 3},
    "neither": {BACKGROUND_TIME: 1, REFRACTORY_TIME: 4000},
    "refractory of no time": {REFRACTORY: 1, REFRACTORY_TIME: 0},
    "nothing passes": {BACKGROUND: 1, BACKGROUND_TIME: 2, REFRACTORY: 1, REFRACTORY_TIME: 3000},
}


@pytest.mark.parametrize("layout", Layout)
@pytest.mark.parametrize("corner", [(0, 0), (346 - 40, 260 - 30)])
@pytest.mark.parametrize("name", ASKED)
def test_what_passes_is_what_the_reference_lets_pass(name, corner, layout):
    bench, reference = Bench(layout), Reference()
    bench.write(ASKED[name])
    reference.write(ASKED[name], 0)
    sent = some_events(corner=corner)
    assert np.array_equal(bench.show(sent), sent[[reference.passes(t, x, y) for t, x, y, _ in sent.tolist()]])
    counters = bench.model.counters
    assert (counters.dropped_background, counters.dropped_refractory) == (reference.isolated, reference.too_soon)
    assert counters.not_selected == 0
    assert counters.accounted == counters.offered == len(sent)
    assert bench.camera.read_register(*BACKGROUND_COUNT) == reference.isolated
    assert bench.camera.read_register(*REFRACTORY_COUNT) == reference.too_soon


def test_the_reference_is_followed_through_changes_of_the_registers():
    bench, reference = Bench(), Reference()
    start_us = 0
    for step, written in enumerate([*ASKED.values(), {BACKGROUND: 0, REFRACTORY: 0}, {BACKGROUND: 1}]):
        bench.write(written)
        reference.write(written, start_us)
        sent = some_events(300, seed=step, start_us=start_us + 700)
        expected = sent[[reference.passes(t, x, y) for t, x, y, _ in sent.tolist()]]
        assert np.array_equal(bench.show(sent), expected)
        start_us = int(sent["t"][-1])


@pytest.mark.system
@given(
    st.lists(st.integers(1, 399), max_size=20), st.integers(0, 5), st.integers(0, 5), st.booleans(), st.integers(0, 99)
)
def test_it_does_not_matter_how_events_are_cut(cuts, age, pause, is_both, seed):
    asked = {BACKGROUND: 1, BACKGROUND_TIME: age, REFRACTORY: int(is_both), REFRACTORY_TIME: pause}
    sent = some_events(400, seed, size=(12, 12))
    whole, cut = Bench(size=(14, 13)), Bench(size=(14, 13))
    for bench in (whole, cut):
        bench.write(asked)
    assert np.array_equal(cut.show(*np.split(sent, sorted(cuts))), whole.show(sent))
    assert cut.model.counters == whole.model.counters


def test_the_other_filters_come_before_it_and_the_skip_filter_after_it():
    asked = {BACKGROUND: 1, 62: 1, 63: 1, 11: 5, 12: 5, 41: 2, 51: 1, 52: 2}
    bench, reference = Bench(), Reference()
    bench.write(asked)
    reference.write({BACKGROUND: 1}, 0)
    sent = some_events()
    before = [x >= 2 and not on and (x, y) != (5, 5) for _, x, y, on in sent.tolist()]
    heard = [e for e, good in zip(sent, before, strict=True) if good and reference.passes(*e.tolist()[:3])]
    assert np.array_equal(bench.show(sent), np.array([e for k, e in enumerate(heard) if k % 3 != 2], EVENT))
    counters = bench.model.counters
    assert counters.not_selected == before.count(False) + len(heard) // 3
    assert counters.dropped_background == reference.isolated > 0


def test_events_that_are_refused_leave_nothing_behind():
    bench = Bench()
    bench.write({BACKGROUND: 1})
    with pytest.raises(ValueError, match="outside the 346 x 260 array"):
        bench.model.offer(events_at((10_000, 9, 9), (10_000, 400, 9), (10_000, 65_535, 65_535)))
    assert bench.model.counters.dropped_background == 0
    assert not len(bench.show(events_at((10_001, 9, 9))))


def test_the_power_clears_the_memory_and_the_statistics():
    bench = Bench()
    bench.write({BACKGROUND: 1})
    bench.show(some_events())
    assert bench.camera.read_register(*BACKGROUND_COUNT) > 0
    bench.model.attached()
    assert DavisHost(DirectHost(bench.model)).read_register(*BACKGROUND_COUNT) == 0
    bench.camera.start(StreamSettings(reset_timestamps=False))
    bench.write({BACKGROUND: 1})
    now_us = bench.model.now_us
    assert len(bench.show(events_at((now_us + 2000, 9, 9), (now_us + 2300, 99, 99)))) == 1


def test_only_a_camera_that_has_the_filters_says_so_and_filters():
    without = Davis346(Davis346Settings(start_delay_us=0))
    camera = DavisHost(DirectHost(without))
    camera.start(StreamSettings(reset_timestamps=False))
    camera.write_registers([(1, BACKGROUND, 1), (1, REFRACTORY, 1)])
    without.offer(events_at((10_000, 9, 9), (10_001, 9, 9)))
    assert len(camera.read(0.0)) == 2
    assert (camera.read_register(1, HAS), Bench().camera.read_register(1, HAS)) == (0, 1)
