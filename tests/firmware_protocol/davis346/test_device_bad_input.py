"""The camera: events and requests with wrong data, settings that it refuses."""

import dataclasses

import pytest
from davis_host import IN, OUT, RUN, Host, events_of, steady

from firmware_protocol.davis346 import Davis346, Davis346Settings
from firmware_protocol.device.fates import Fates
from firmware_protocol.events import empty_events
from firmware_protocol.usb.device import Stall

PROMPT = Davis346Settings(start_delay_us=0)


def running(**changes):
    """A camera that streams from time zero, and its host."""
    camera = Davis346(dataclasses.replace(PROMPT, **changes))
    host = Host(camera, camera.settings.layout.turned)
    host.write_all(RUN)
    return camera, host


def balanced(counters):
    """The sum of all fates is what was offered."""
    return counters.offered == counters.accounted


# --- bad input


def test_events_that_go_back_in_time_are_refused_whole():
    camera, host = running()
    camera.advance(1000)
    for bad in (
        events_of((999, 1, 1, True)),
        events_of((40_000, 1, 1, True), (39_999, 1, 1, True)),
        events_of((1000, 346, 0, True)),
    ):
        with pytest.raises(ValueError, match=r"offered after|sorted|outside"):
            camera.offer(bad)
    assert camera.counters == Fates()
    assert host.data() == b""
    camera.offer(events_of((1000, 1, 1, True)))
    assert host.decoded().events.tolist() == [(1000, 1, 1, True)]


def test_an_empty_offer_is_nothing():
    camera, _ = running()
    camera.offer(empty_events())
    assert camera.counters == Fates()


@pytest.mark.parametrize(
    ("kind", "request_code", "value", "index", "data", "length"),
    [
        (OUT, 0xBF, 0, 0, b"\0\0\0", 3),
        (OUT, 0xBF, 0, 0, b"\0\0\0\0\1", 5),
        (OUT, 0xBF, 0, 0, b"\0\0", 4),
        (OUT, 0xBF, 0, 0, b"", 0),
        (OUT, 0xC2, 2, 0, bytes(6), 6),
        (OUT, 0xC2, 1, 0, bytes(12), 12),
        (OUT, 0xC2, 2, 0, bytes((1, 4, 0, 0, 0, 1, 1, 5)), 12),
        (OUT, 0xB1, 4, 0, b"\0", 1),
        (OUT, 0xC6, 0, 0, b"\0", 1),
        (OUT, 0xB2, 0, 0, b"", 0),
        (OUT, 0xBE, 0, 0, bytes(64), 64),
        (OUT, 0xA0, 0, 0, bytes(64), 64),
        (IN, 0xBF, 6, 0, b"", 3),
        (IN, 0xB3, 0, 0, b"", 64),
        (IN, 0xC2, 1, 0, b"", 6),
        (0x41, 0xBF, 0, 0, bytes(4), 4),
        (0x20, 0xBF, 0, 0, bytes(4), 4),
        (0x60, 0xBF, 0, 0, bytes(4), 4),
    ],
)
def test_wrong_or_unknown_requests_stall_and_change_nothing(kind, request_code, value, index, data, length):
    camera, host = running()
    before = [host.read(m, p) for m in range(10) for p in range(145)]
    with pytest.raises(Stall):
        host.control(kind, request_code, value, index, data, length)
    assert [host.read(m, p) for m in range(10) for p in range(145)] == before
    assert camera.streaming


def test_an_empty_multi_write_writes_nothing():
    _, host = running()
    assert host.control(OUT, 0xC2, 0, 0) == b""


def test_a_register_reply_is_four_bytes_whatever_more_is_asked_for():
    _, host = running()
    assert host.control(IN, 0xBF, 6, 0, length=64) == b"\0\0\0\x12"


def test_endpoints():
    camera, host = running()
    assert camera.read(1, 64) is None
    for endpoint in (0, 3, 15):
        with pytest.raises(Stall):
            camera.read(endpoint, 64)
    camera.offer(steady(3))
    host.control(0x02, 3, 0, 0x82)
    with pytest.raises(Stall):
        camera.read(2, 64)
    host.clear_halt()
    assert len(camera.read(2, 64).events) == 3


def test_a_camera_that_is_not_configured_has_no_endpoints():
    camera = Davis346(PROMPT)
    camera.attached()
    with pytest.raises(Stall):
        camera.read(2, 64)


@pytest.mark.parametrize(
    ("field", "value"),
    [("serial", ""), ("serial", "123456789"), ("serial", "é"), ("bcd_device", 0x10000), ("start_delay_us", -1)],
)
def test_bad_settings_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        Davis346Settings(**{field: value})


def test_a_fifo_too_small_or_an_array_too_large_is_refused():
    with pytest.raises(ValueError, match="1000 bytes"):
        Davis346(Davis346Settings(fifo_bytes=1000))
    with pytest.raises(ValueError, match="5000 x 10"):
        Davis346(Davis346Settings(size=(5000, 10)))
