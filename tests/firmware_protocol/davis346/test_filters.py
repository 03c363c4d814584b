"""The filters of the DVS module, each against its rule written as a loop, and the fates of what they keep back."""

import numpy as np
import pytest

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.registers import Layout
from firmware_protocol.events import EVENT
from tests.made_events import steady
from transports.usb.davis_host import DavisHost
from transports.usb.host import StreamSettings
from transports.usb.loopback import DirectHost

STATISTICS_HOT = (1, 88)


def some_events(count=3000, seed=1, start_us=1000):
    return steady(count, start_us, 5, seed, (20, 20))


def by_rule(events, written):
    """Pass events one by one through the filters, as the documents describe them."""
    passed, count = [], 0
    get = {41: 0, 42: 0, 43: 345, 44: 259, 61: 0, 62: 0, 63: 0, 51: 0, 52: 5, **written}.get
    hot = {(get(12 + 2 * k), get(11 + 2 * k)) for k in range(8)}
    for t, x, y, on in events.tolist():
        if get(62) and on == bool(get(63)):
            continue
        if not (get(41) <= x <= get(43) and get(42) <= y <= get(44)) or (x, y) in hot:
            continue
        if get(51):
            count += 1
            if count % (get(52) + 1) == 0:
                continue
        passed.append((t, x, y, on and not get(61)))
    return np.array(passed, EVENT)


class Bench:
    def __init__(self, layout=Layout.UPRIGHT):
        self.model = Davis346(Davis346Settings(start_delay_us=0, layout=layout))
        self.camera = DavisHost(DirectHost(self.model))
        self.camera.start(StreamSettings(reset_timestamps=False))

    def write(self, written):
        self.camera.write_registers([(1, address, value) for address, value in written.items()])

    def show(self, events, parts=1):
        for part in np.array_split(events, parts):
            self.model.offer(part)
        received = [np.zeros(0, EVENT)]
        while (some := self.camera.read(0.0)) is not None:
            received.append(some)
        return np.concatenate(received)


ASKED = {
    "polarity flattened": {61: 1},
    "ON suppressed": {62: 1, 63: 1},
    "OFF suppressed": {62: 1, 63: 0},
    "flattened, ON suppressed": {61: 1, 62: 1, 63: 1},
    "region": {41: 3, 42: 5, 43: 12, 44: 11},
    "region upside down": {41: 12, 43: 3},
    "hot pixels": {11: 4, 12: 7, 25: 0, 26: 19},
    "skip": {51: 1, 52: 3},
    "skip all": {51: 1, 52: 0},
    "skip number alone": {52: 3},
    "all at once": {41: 1, 43: 18, 11: 4, 12: 7, 51: 1, 52: 2, 61: 1, 62: 1},
}


@pytest.mark.parametrize("parts", [1, 7])
@pytest.mark.parametrize("name", ASKED)
def test_what_passes_is_what_the_rule_lets_pass(name, parts):
    sent, bench = some_events(), Bench()
    bench.write(ASKED[name])
    received = bench.show(sent, parts)
    assert np.array_equal(received, by_rule(sent, ASKED[name]))
    counters = bench.model.counters
    assert counters.not_selected == len(sent) - len(received)
    assert counters.accounted == counters.offered == len(sent)


@pytest.mark.parametrize("layout", Layout)
def test_coordinates_are_the_users_in_both_layouts(layout):
    sent, bench = some_events(), Bench(layout)
    asked = {41: 2, 42: 6, 43: 9, 44: 15, 11: 8, 12: 3}
    bench.write(asked)
    assert np.array_equal(bench.show(sent), by_rule(sent, asked))


def test_the_statistics_count_hot_pixels_since_power_on():
    sent, bench = some_events(), Bench()
    bench.write({11: 4, 12: 7, 41: 1})
    bench.show(sent)
    assert bench.camera.read_register(*STATISTICS_HOT) == np.count_nonzero((sent["x"] == 7) & (sent["y"] == 4)) > 0
    bench.model.attached()
    assert DavisHost(DirectHost(bench.model)).read_register(*STATISTICS_HOT) == 0


def test_events_that_are_refused_are_not_counted():
    bench = Bench()
    bench.write({51: 1, 52: 1, 62: 1})
    bad = some_events(10)
    bad["x"][5:], bad["on"] = 400, True
    with pytest.raises(ValueError, match="outside the 346 x 260 array"):
        bench.model.offer(bad)
    assert bench.model.counters.not_selected == 0
    sent = some_events(10, seed=2)
    assert np.array_equal(bench.show(sent), by_rule(sent, {51: 1, 52: 1, 62: 1}))


def test_capabilities_tell_which_filters_there_are():
    camera = Bench().camera
    assert {k: camera.read_register(1, k) for k in (10, 30, 40, 50, 60)} == {10: 1, 30: 0, 40: 1, 50: 1, 60: 1}
