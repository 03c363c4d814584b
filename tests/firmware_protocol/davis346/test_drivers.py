"""The start and stop sequences of three drivers, as they were logged, against the camera."""

import numpy as np
import pytest
from davis_host import SENSORS, STOP, Host, steady

from firmware_protocol.davis346 import BIASES, Davis346

IDENTITY_READS = [(6, 0), (6, 7), (6, 1), (6, 2), (1, 10), (1, 30), (1, 40), (1, 50), (1, 60), (1, 80), (2, 3), (2, 6),
                  (4, 10), (0, 80), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2), (3, 0)]  # fmt: skip
CLOCK_READS = [(6, 3), (6, 4), (6, 5), (6, 6), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2), (3, 1)]
DEFAULTS = [(5, b.address, int(b.default)) for b in BIASES] + [
    (5, 136, 1), (5, 143, 1), (0, 4, 1), (0, 5, 1), (1, 4, 0), (1, 5, 0), (2, 5, 1), (2, 7, 1), (5, 142, 1),
    (2, 12, 120000), (2, 13, 1200000), (3, 5, 0), (3, 6, 1), (3, 7, 1), (3, 10, 1), (4, 1, 0), (4, 2, 0), (9, 1, 80000),
]  # fmt: skip


def identify(host):
    reads = {key: host.read(*key) for key in IDENTITY_READS + CLOCK_READS}
    assert reads[6, 0] == 18
    assert reads[6, 7] >= 1
    assert reads[6, 1] == 5
    assert {reads[1, 0], reads[1, 1]} == {346, 260}
    assert min(reads[6, k] for k in (3, 4, 5, 6)) > 0


def open_libcaer(host):
    """dv-processing 1.7.9: stop block, chip, 200 ms, transfers are queued before the run bits."""
    identify(host)
    host.write_all(DEFAULTS)
    host.write_all(STOP)
    pause(host, 10_000)
    host.clear_halt()
    host.write(0, 3, 1)
    pause(host, 200_000)
    host.write_all([(9, 0, 1), (0, 1, 1), (0, 0, 1)])
    pause(host, 50_000)
    host.write_all(SENSORS)
    host.reset_timestamps()


def open_dv(host):
    """dv-processing 2.0.4: log level, flush, stop block, flush, settings, run, reset; waits for the reset word."""
    host.control(0x40, 0xB1, 4, 0)
    host.control(0x40, 0xC6, 0, 0)
    host.clear_halt()
    identify(host)
    host.write_all([*STOP, (4, 11, 0)])
    host.control(0x40, 0xC6, 0, 0)
    host.clear_halt()
    host.multi_write([(1, 31, 0), (1, 32, 0), (1, 33, 0)])
    host.write_all(DEFAULTS)
    host.write_all([(0, 3, 1), (9, 0, 1), (0, 1, 1), (0, 0, 1), *SENSORS, (4, 11, 0)])
    host.reset_timestamps()


def open_neuromorphic(host):
    """neuromorphic_drivers 0.18.2: reads first, sensor on, transfers only then, no reset."""
    identify(host)
    host.write_all([*STOP, (4, 11, 0)])
    pause(host, 100_000)
    host.clear_halt()
    host.multi_write([(1, 11 + k, 260) for k in range(16)])
    host.write_all(DEFAULTS)
    host.write_all([(0, 3, 1), (9, 1, 80000)])
    pause(host, 200_000)
    host.write_all([(9, 0, 1), (0, 5, 1), (0, 4, 1), (0, 1, 1), (0, 0, 1)])
    pause(host, 50_000)
    host.write_all([(1, 4, 0), (1, 5, 0), (1, 3, 1), (2, 5, 1), (2, 7, 1), (5, 142, 1), (2, 4, 1), (3, 2, 1)])


def pause(host, for_us):
    host.camera.advance(host.camera.now_us + for_us)


def stream(host, events, batch=1000):
    got = []
    for first in range(0, len(events), batch):
        host.camera.offer(events[first : first + batch])
        got.append(host.decoded().events)
    return np.concatenate(got)


@pytest.mark.parametrize("opens", [open_libcaer, open_dv])
def test_a_driver_that_resets_sees_the_reset_at_once_and_every_event_after_it(opens):
    camera = Davis346()
    host = Host(camera)
    for _ in range(3):
        opens(host)
        first = host.decoded()
        assert first.specials["code"].tolist() == [1]
        assert camera.streaming
        epoch_us = camera.now_us
        events = steady(20_000, start_us=epoch_us, step_us=3)
        got = stream(host, events)
        got["t"] += epoch_us
        assert np.array_equal(got, events)
        host.write_all(STOP)
        assert not camera.streaming
    assert host.decoder.faults.total == 0


def test_neuromorphic_drivers_gets_silence_and_then_every_event():
    camera = Davis346()
    host = Host(camera)
    camera.advance(5_000_000)
    open_neuromorphic(host)
    opened_us = camera.now_us
    start_us = opened_us - 50_000
    camera.offer(steady(100, start_us=opened_us))
    camera.advance(opened_us + 299_999)
    assert camera.read(2, 131072) is None
    assert not camera.streaming
    camera.advance(opened_us + 300_000)
    assert camera.streaming
    events = steady(20_000, start_us=camera.now_us, step_us=3)
    got = stream(host, events)
    got["t"] += start_us
    assert np.array_equal(got, events)
    assert camera.counters.not_running == 100
    assert host.decoder.faults.total == 0
