"""The dissector, run by tshark over captures that are written here: every value is what went into the packet."""

import shutil
import struct
import subprocess
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
from ground_packets import COMMANDS, SAMPLES, T_US
from icd_examples import EDGES as CAN_EDGES
from icd_examples import EVENTS as CAN_EVENTS
from icd_examples import EXAMPLES

from firmware_protocol.can_frames.dbc import Identifiers, can_messages
from firmware_protocol.can_frames.transport import IsoTpReceiver, IsoTpSender, IsoTpSettings
from firmware_protocol.ground.description import instrument_packets
from firmware_protocol.ground.wireshark import wireshark_text

TSHARK = shutil.which("tshark")
pytestmark = pytest.mark.skipif(TSHARK is None, reason="tshark is not installed (Debian package tshark)")

IDS = Identifiers.of_node(0x22).by_name
RAW, USER0, SOCKETCAN = 101, 147, 227
PORT = 10015


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    path = tmp_path_factory.mktemp("wireshark") / "evstim.lua"
    frames = [(IDS[one.name], one) for one in can_messages()]
    path.write_text(wireshark_text(instrument_packets(), (PORT, 10025), frames), encoding="utf-8")
    return path


def dissected(script, link_type, frames, *more):
    """Return what tshark makes of frames: for each, {filter name: list of fields}."""
    capture = script.with_name("capture.pcap")
    data = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65_535, link_type)
    capture.write_bytes(data + b"".join(struct.pack("<IIII", 0, 0, len(f), len(f)) + f for f in frames))
    command = [TSHARK, "-X", f"lua_script:{script}", "-r", capture, "-T", "pdml", *more]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert "Lua" not in done.stderr, done.stderr
    packets = Xml.fromstring(done.stdout).findall("packet")
    assert len(packets) == len(frames)
    return [fields_of(packet) for packet in packets]


def fields_of(packet):
    fields = {}
    for one in packet.iter("field"):
        fields.setdefault(one.get("name"), []).append(one)
    return fields


def value_of(one, like):
    """Return a field as text, exact integer or float, whichever `like` is."""
    if isinstance(like, str):
        return one.get("showname").partition(": ")[2].partition(" (")[0]
    return float(one.get("show")) if isinstance(like, float) else int(one.get("show"), 0)


def datagram(octets, port=PORT):
    """An IPv4 datagram; its checksums are left out, which tshark does not look at by default."""
    udp = struct.pack(">HHHH", 40_000, port, 8 + len(octets), 0) + octets
    return struct.pack(">BBHHHBBH4B4B", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, *(127, 0, 0, 1), *(127, 0, 0, 1)) + udp


def check(fields, sample):
    for name, value in sample.values.items():
        (one,) = fields[f"evstim.{sample.name.lower()}.{name}"]
        assert value_of(one, value) == value, name
    assert [one.get("showname") for one in fields["evstim.error_control.good"]] == ["error control good: True"]


@pytest.mark.parametrize(("link_type", "carried"), [(USER0, bytes), (RAW, datagram)])
def test_every_packet_is_read_as_it_was_made(script, link_type, carried):
    samples = [*SAMPLES, *COMMANDS]
    for fields, sample in zip(dissected(script, link_type, [carried(s.octets) for s in samples]), samples, strict=True):
        check(fields, sample)
        assert "_ws.expert" not in fields


def test_the_headers_are_read(script):
    fields, second = dissected(script, USER0, [one.octets for one in SAMPLES[-2:]])
    told = {name: int(fields[f"evstim.{name}"][0].get("show"), 0) for name in ("apid", "service", "subtype", "length")}
    assert told == {"apid": 0x2A0, "service": 17, "subtype": 2, "length": 15}
    assert int(fields["evstim.time_seconds"][0].get("show")) == T_US // 1_000_000
    assert float(fields["evstim.time_fraction"][0].get("show")) == 0.75
    assert int(second["evstim.type_count"][0].get("show")) == 1


def test_the_part_of_varying_length_is_read(script):
    samples = {one.name: one for one in SAMPLES}
    names = ("EVENTS", "EDGES", "VERIFICATION_NOT_COMPLETED")
    events, edges, failed = dissected(script, USER0, [samples[name].octets for name in names])
    assert bytes.fromhex(events["evstim.events.payload"][0].get("value")) == samples["EVENTS"].rest
    text = failed["evstim.verification_not_completed.failure_text"][0].get("show")
    assert text == "tick 7 us is none of 1, 10, 100, 1000"
    told = [[int(one.get("show")) for one in edges[f"evstim.edges.edges.{name}"]] for name in ("t", "kind", "seq")]
    assert told == [[0, 123_456], [2, 3], [7, 65_535]]


def test_several_packets_in_a_datagram_are_read(script):
    (fields,) = dissected(script, RAW, [datagram(b"".join(one.octets for one in SAMPLES))])
    assert len(fields["evstim.apid"]) == len(SAMPLES)
    assert len(fields["evstim.error_control.good"]) == len(SAMPLES)


def test_a_wrong_bit_is_told(script):
    octets = bytearray(SAMPLES[0].octets)
    octets[40] ^= 1
    (fields,) = dissected(script, USER0, [bytes(octets)])
    assert fields["evstim.error_control.good"][0].get("showname").endswith("False")
    assert "evstim.bad_crc" in fields


@pytest.mark.parametrize(
    ("octets", "told"),
    [
        (SAMPLES[0].octets[:-1], "evstim.bad_length"),
        (SAMPLES[0].octets[:5], "evstim.bad_length"),
        (bytes.fromhex("0aa0 c000 0001 2003"), "evstim.unknown"),
        (bytes.fromhex("0aa0 c000 0003 20032500"), "evstim.unknown"),
        (bytes.fromhex("0aa0 c000 0003 20031900"), "evstim.bad_length"),
        (bytes.fromhex("07ff c000 0000 55"), "evstim.unknown"),
    ],
)
def test_bad_octets_are_told_and_stop_nothing(script, octets, told):
    bad, good = dissected(script, USER0, [octets, SAMPLES[0].octets])
    assert told in bad
    check(good, SAMPLES[0])


def can_frame(identifier, data):
    return struct.pack(">IBBBB", identifier, len(data), 0, 0, 0) + data


def test_a_packet_in_frames_of_isotp_is_put_together(script):
    sender, receiver = IsoTpSender(IsoTpSettings(0x4A2, 0x522)), IsoTpReceiver(IsoTpSettings(0x522, 0x4A2))
    sender.start(SAMPLES[0].octets)
    frames = [sender.next_frame(0)]
    receiver.push(frames[0], 0)
    sender.flow_control(receiver.reply, 0)
    while (frame := sender.next_frame(0)) is not None:
        frames.append(frame)
    as_packets = ("-d", "can.subdissector,iso15765", "-d", "iso15765.subdissector,evstim")
    told = dissected(script, SOCKETCAN, [can_frame(IDS["telemetry"], one.data) for one in frames], *as_packets)
    check(told[-1], SAMPLES[0])


def test_frames_of_the_can_bus_are_read(script):
    names = {
        "events, classic": "events",
        "edges and marks": "edges",
        "epoch": "epoch",
        "clock": "clock",
        "emcy": "emcy",
    }
    names |= {"follow_up": "follow_up", "scet": "scet", "heartbeat": "heartbeat"}
    frames = [can_frame(IDS[name], EXAMPLES[example]) for example, name in names.items()]
    told = dict(zip(names.values(), dissected(script, SOCKETCAN, frames), strict=True))

    def read(name, *signals):
        return [float(told[name][f"evstim_can.{name}.{one}"][0].get("show")) for one in signals]

    assert read("events", "x0", "y0", "on0", "x1", "y1", "on1") == [
        float(CAN_EVENTS[key][n]) for n in (0, 1) for key in ("x", "y", "on")
    ]
    assert read("events", "dt", "seq") == [float(np.diff(CAN_EVENTS["t"])[0]), 5]
    assert read("edges", "t", "kind", "seq") == [float(CAN_EDGES[key][0]) for key in ("t", "kind", "seq")]
    assert read("epoch", "t", "tick", "sent", "dropped") == [15_000, 2, 1400, 3]
    assert read("clock", "t") == [1_500_000]
    assert read("emcy", "code", "dropped") == [0x8110, 1000]
    assert read("follow_up", "counter", "sent") == [9, 1_500_000_000]
    assert read("scet", "seconds", "fraction") == [1, 0.5]
    assert read("heartbeat", "state") == [5]
