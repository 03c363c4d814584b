"""Bytes that break the rules, for each parser that reads what a peer of a port sends.

A thousand for each parser by default; `EVSTIM_HOSTILE_INPUTS=1000000` for the figures of docs/robustness.md. Half of
the inputs are good messages with some bytes changed, cut or repeated: noise alone seldom gets past the first check.
"""

import json
import os
import random
import struct

import pytest

from emulator.rig.loading import parse_rig
from emulator.run.control import FaultInjection, _answered
from emulator.run.outcome import RunStatus
from emulator.run.pacing import Lateness
from firmware_protocol.can_frames.socketcand import SocketcandSession
from firmware_protocol.usb.usbip import (
    DeviceListRequest,
    ImportRequest,
    Limits,
    ServerParser,
    Submit,
    Unlink,
    UsbipError,
)
from transports.faults.kinds import FAULTS

COUNT = int(os.environ.get("EVSTIM_HOSTILE_INPUTS", "1000"))
OUT_BYTES = 1024
OPERATIONS = [bytes(DeviceListRequest()), bytes(ImportRequest("1-1"))]
URBS = [
    bytes(Submit(7, 0x10002, is_in=True, endpoint=2, length=512)),
    bytes(Submit(8, 0x10002, is_in=False, endpoint=0, length=4, setup=bytes(8), data=b"\1\2\3\4")),
    bytes(Unlink(9, 0x10002, 7)),
]
COMMANDS = [
    b"< open can0 >",
    b"< rawmode >",
    b"< echo >",
    b"< send 1A2 2 0 11 >",
    b"< send 000001A2 8 0 1 2 3 4 5 6 7 >",
]
RIG = """
[scene]
kind = "checkerboard"
square_px = 40.0
speed_px_s = 3.0
[[links]]
kind = "serial"
port = "pty"
[[links]]
kind = "can"
[links.instrument]
region = [0, 0, 64, 64]
[[links]]
kind = "usbip"
"""
VALUES = [None, True, -1, 0, 3, 0.5, 1e308, float("nan"), float("inf"), 10**400, "", "A", "can", "serial", [], {}, [[]]]


def damaged(good, rng):
    """Return a few messages in a row, most of them with something wrong."""
    data = bytearray(b"".join(rng.choices(good, k=rng.randint(1, 3))))
    for _ in range(rng.randint(0, 4)):
        at = rng.randrange(len(data) + 1)
        match rng.randrange(5):
            case 0:
                data[at:at] = rng.randbytes(rng.randint(1, 8))
            case 1:
                del data[at : at + rng.randint(1, 8)]
            case 2 if at < len(data):
                data[at] ^= 1 << rng.randrange(8)
            case 3 if at + 4 <= len(data):
                data[at : at + 4] = struct.pack(">i", rng.choice([-1, 0, 1, 0x7FFFFFFF, -0x80000000, OUT_BYTES + 1]))
            case _:
                data += data[at:]
    return bytes(data[:4096])


def inputs(good, seed):
    rng = random.Random(seed)
    for n in range(COUNT):
        yield damaged(good, rng) if n % 2 else rng.randbytes(rng.randint(0, 200))


@pytest.mark.parametrize(("good", "urbs"), [(OPERATIONS, False), (URBS, True)], ids=["operations", "urbs"])
def test_usbip(good, urbs):
    ended = 0
    for data in inputs(good, 1):
        parser = ServerParser(Limits(out_bytes=OUT_BYTES))
        if urbs:
            parser.begin_urbs()
        parser.receive(data)
        try:
            while parser.next_message() is not None:
                pass
            assert len(parser._buffer) < 48 + OUT_BYTES
        except UsbipError:
            ended += 1
    assert COUNT // 10 < ended < COUNT


def test_socketcand():
    session, taken = SocketcandSession("can0"), 0
    session.push(COMMANDS[0])
    for data in inputs(COMMANDS, 2):
        answer, frames = session.push(data)
        assert len(answer) <= 13 * (len(data) + 4096)
        assert len(session._unread) <= 4096
        assert all(len(frame.data) <= 8 and 0 <= frame.identifier < 1 << 29 for frame in frames)
        taken += len(frames)
    assert taken > COUNT // 10


class Session:
    def order(self, link, order):
        assert order.fault.kind in FAULTS


def test_control():
    desk = FaultInjection(parse_rig(RIG, "bench.toml", "bench"), Session(), None)
    now = RunStatus(1.5, 1.6, 10, 100, Lateness(), {})
    rng = random.Random(3)
    good = [b'{"request": "faults"}\n']
    for kind, fault in FAULTS.items():
        table = {name: rng.choice(VALUES) for name in fault.__dataclass_fields__ if rng.random() < 0.3}
        good.append(json.dumps({"request": "inject", "fault": {"kind": kind}}).encode() + b"\n")
        good.append(json.dumps({"request": "inject", "fault": {**table, "kind": kind}}).encode() + b"\n")
    told = {"error": 0, "links": 0, "link": 0}
    for data in inputs([*good, b"[" * 2000, b'{"a":' * 2000], 4):
        answer = _answered(data, lambda message: desk.answer(message, now))
        assert json.loads(json.dumps(answer)) is not None
        told[next(key for key in told if key in answer)] += 1
    assert told["error"] > COUNT // 2
    assert told["links"] + told["link"] > 0
