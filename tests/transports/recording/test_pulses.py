"""Pulses at a camera's input: every camera and format records each as it was sent, by count, polarity and length."""

import evt3
import numpy as np
import pytest

from emulator.rig.kinds import CAMERA_MODELS
from emulator.rig.loading import parse_rig
from emulator.run.assembly import link_setups
from firmware_protocol.device.plain_device import own_time
from firmware_protocol.events import EVENT, EdgeKind, make_edges
from firmware_protocol.evt.words import evt3_header
from firmware_protocol.recordings.part import Facts, Part
from tests.firmware_protocol.evt2_words import by_the_tables
from tests.firmware_protocol.gige_host import Host as GigeHost
from tests.npz_records import load_edges
from tests.transports.recording.test_other_readers import dv_processing, messages_of
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS
from transports.recording.rosbag import EVENT_PACKET
from transports.usb.cameras import driver_of
from transports.usb.host import StreamSettings
from transports.usb.loopback import DirectHost

COUNT, PERIOD_US, PULSE_US, DETECTED_US = 10, 1000, 300, 1
RISES = range(PERIOD_US, (COUNT + 1) * PERIOD_US, PERIOD_US)
LEVELS = sorted([(t, EdgeKind.RISING) for t in RISES] + [(t + PULSE_US, EdgeKind.FALLING) for t in RISES])
DETECTED = sorted([*LEVELS, *((t + DETECTED_US, EdgeKind.PULSE) for t in RISES)])
"""What a camera with a pulse detector sends when a host has it report edges and pulses."""


def device_of(model, kind):
    """The device of a rig's link, as its process makes it."""
    link = f'[[links]]\nkind = "{kind}"\n' + ('path = "a.raw"\n' if kind == "file" else "")
    trigger = f"[trigger]\nperiod_ms = {PERIOD_US / 1000}\npulse_us = {PULSE_US}\n"
    camera = f'[camera]\nmodel = "{model}"\nstart_delay_ms = 0\n'
    rig = parse_rig(f'[scene]\nkind = "checkerboard"\n{camera}{trigger}{link}', "a.toml", "a")
    return link_setups(rig)[0].device()


def offer_pulses(device):
    edges = make_edges(RISES, EdgeKind.PULSE)
    device.offer_edges(edges)
    device.advance(2 * COUNT * PERIOD_US)


def sent_by_usb(model):
    device = device_of(model, "loopback" if model in ("davis346", "ideal") else "usbip")
    host = DirectHost(device)
    camera = driver_of(host)
    camera.start(StreamSettings(edges=True))
    offer_pulses(device)
    while camera.read(0.0) is not None:
        yield own_time(host.reader.last.edges, host.reader.last.epoch_us)


def sent_by_gige(model):
    host = GigeHost()
    host.camera = device_of(model, "gige")
    host.start()
    offer_pulses(host.camera)
    return [outgoing.edges for outgoing in host.blocks()]


def sent_without_electronics(model):
    device = device_of(model, "file")
    offer_pulses(device)
    return [device.take(100).edges]


SENDERS = [
    *((name, sent_by_usb) for name, model in CAMERA_MODELS.items() if model.usb and "micro" not in name),
    *((name, sent_by_gige) for name, model in CAMERA_MODELS.items() if model.gige),
    *((name, sent_without_electronics) for name in CAMERA_MODELS),
]


def pairs(edges):
    return [(int(edge["t"]), int(edge["kind"])) for edge in edges]


@pytest.mark.parametrize(("model", "edges_of"), SENDERS, ids=lambda value: getattr(value, "__name__", value))
def test_a_camera_sends_both_levels_of_each_pulse(model, edges_of):
    edges = np.concatenate(list(edges_of(model)))
    has_detector = edges_of is sent_by_usb and model in ("davis346", "davis240c", "ideal", "dvxplorer")
    assert pairs(edges) == (DETECTED if has_detector else LEVELS)


def by_dv_processing(path):
    reader, read = dv_processing.io.MonoCameraRecording(str(path)), []
    while (batch := reader.getNextTriggerBatch()) is not None:
        read += [(trigger.timestamp, trigger.type.value + 1) for trigger in batch]
    return read


def by_evt3(path):
    triggers = evt3.decode_file_with_triggers(str(path))[1]
    return [(int(t), 2 if value else 3) for t, value in zip(triggers.timestamp, triggers.value, strict=True)]


def by_rosbags_and_evt3(path):
    packets = [packet for _, packet in messages_of(path, {"event_camera_msgs/msg/EventPacket": EVENT_PACKET})]
    (path.parent / "words.raw").write_bytes(evt3_header((1280, 720)) + b"".join(p.events.tobytes() for p in packets))
    return by_evt3(path.parent / "words.raw")


def by_the_tables_of(form):
    return lambda path: pairs(by_the_tables(path.read_bytes().partition(b"% end\n")[2], form)[1])


def by_ourselves(name):
    """No other package reads the triggers of these formats."""
    return lambda path: pairs(np.concatenate([part.edges for part in FORMATS[name].open_reader(path).parts()]))


READERS = {
    "aedat4": by_dv_processing,
    "aedat2": by_ourselves("aedat2"),
    "aedat31": by_ourselves("aedat31"),
    "evt3": by_evt3,
    "evt2": by_the_tables_of("evt2"),
    "evt21": by_the_tables_of("evt21"),
    "evt21-legacy": by_the_tables_of("evt21-legacy"),
    "ros1": by_rosbags_and_evt3,
    "ros2": by_rosbags_and_evt3,
    "npz": lambda path: pairs(load_edges(path)[0]),
}


def test_every_format_of_triggers_has_a_reader_here():
    assert set(READERS) == {name for name, form in FORMATS.items() if "edges" in form.holds}


@pytest.mark.parametrize("name", READERS)
def test_pulses_are_recorded_as_they_were_sent(name, tmp_path):
    sent = make_edges(*zip(*DETECTED, strict=True))
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    file = RecordingFile(path, FORMATS[name], Facts((1280, 720) if name != "aedat2" else (346, 260)))
    file.write(Part(np.array([(PERIOD_US // 2, 1, 1, True)], EVENT), sent))
    file.close()
    expected = pairs(sent) if name in ("aedat4", "aedat2", "aedat31", "npz") else LEVELS
    assert READERS[name](path) == expected
    assert file.left_out["edges"] == len(sent) - len(expected)
