"""Does an AEDAT4 file that dv-processing's own writer made of the camera have what its client saw, as a real one's has?

What a real file looks like is taken from a public recording of a DAVIS346 that DV made, in faery's test data: four
streams in this order, LZ4, `source` DAVIS346_ and the serial number; 25 frames and some 1000 samples a second; four
triggers a frame. faery, which shares no code with the writer, reads the packets; dv-processing reads the whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import dv_processing
import numpy as np
from faery.extension import aedat

from firmware_protocol.events import EdgeKind
from tests.guest.streaming import Seen

__all__ = ["assert_same_file"]

NAME = "DAVIS346_00000346"
SIZE = (346, 260)
STREAMS = [
    {"originalOutputName": "events", "typeIdentifier": "EVTS", "sizeX": 346, "sizeY": 260},
    {"originalOutputName": "frames", "typeIdentifier": "FRME", "sizeX": 346, "sizeY": 260},
    {"originalOutputName": "imu", "typeIdentifier": "IMUS"},
    {"originalOutputName": "triggers", "typeIdentifier": "TRIG"},
]
FRAME_START, FRAME_END, EXPOSURE_START, EXPOSURE_END = 6, 7, 8, 9  # sources of triggers
FRAME_PARTS = [FRAME_START, EXPOSURE_START, EXPOSURE_END, FRAME_END]
KINDS = {1: EdgeKind.RISING, 2: EdgeKind.FALLING, 3: EdgeKind.PULSE}
PACKET_US = 10_000
SAMPLE_US = 1000
STEADY = 10  # intervals, before libcaer's automatic exposure makes them longer
CLOCK_US = 5  # drift of 50 ppm over a frame, and rounding


def assert_same_file(path: Path, seen: Seen, frame_us: int) -> None:
    """Assert that a file has what a client saw, in the packets of its driver, and a frame each `frame_us`."""
    described, packets = _read(path)
    assert described == [one | {"compression": "LZ4", "source": NAME} for one in STREAMS]
    for told in packets.values():
        assert all((np.diff(np.concatenate(told)["t"].astype(np.int64)) >= 0).tolist())
    _assert_events(packets["events"], seen)
    _assert_samples(np.concatenate(packets["imus"]), seen)
    _assert_triggers(np.concatenate(packets["triggers"]), seen)
    assert abs(float(np.median(np.diff(seen.frame_t)[:STEADY])) - frame_us) <= CLOCK_US
    _assert_read_by_its_own_library(path, seen)


def _read(path: Path) -> tuple[list[dict[str, Any]], Mapping[str, list[Any]]]:
    """Return what the head tells of each stream, and the packets by kind; of frames none."""
    with aedat.Decoder(path) as decoder:
        described = [_attributes(node) for node in decoder.description()[0].nodes]
        packets: dict[str, list[Any]] = {"events": [], "imus": [], "triggers": []}
        for track, packet in decoder:
            if track.data_type != "frame":
                packets[track.data_type].append(packet)
    wanted = ("originalOutputName", "typeIdentifier", "sizeX", "sizeY", "compression", "source")
    return [{key: one[key] for key in wanted if key in one} for one in described], packets


def _attributes(node: Any) -> dict[str, Any]:
    told = {key: one.value for key, one in node.attributes.items()}
    for inner in node.nodes:
        told |= _attributes(inner)
    return told


def _assert_events(packets: list[Any], seen: Seen) -> None:
    events = np.concatenate(packets)
    for name in ("t", "x", "y", "on"):
        assert np.array_equal(events[name], seen.events[name]), name
    spans_us = [int(packet["t"][-1]) - int(packet["t"][0]) for packet in packets]
    assert max(spans_us) <= PACKET_US
    assert len(packets) >= (int(events["t"][-1]) - int(events["t"][0])) / PACKET_US


def _assert_samples(samples: Any, seen: Seen) -> None:
    assert samples["t"].astype(np.int64).tolist() == seen.imu_t.tolist()
    columns = [f"accelerometer_{a}" for a in "xyz"] + ["temperature"] + [f"gyroscope_{a}" for a in "xyz"]
    assert np.array_equal(np.column_stack([samples[name] for name in columns]).astype(np.float64), seen.imu)
    assert abs(float(np.median(np.diff(seen.imu_t))) - SAMPLE_US) <= CLOCK_US


def _assert_triggers(triggers: Any, seen: Seen) -> None:
    external = triggers[np.isin(triggers["source"], list(KINDS))]
    assert external["t"].astype(np.int64).tolist() == seen.triggers["t"].astype(np.int64).tolist()
    assert [KINDS[source] for source in external["source"].tolist()] == seen.triggers["kind"].tolist()
    parts = triggers[np.isin(triggers["source"], FRAME_PARTS)]
    assert parts["source"].tolist() == (FRAME_PARTS * len(parts))[: len(parts)]
    _assert_exposures(parts["t"][parts["source"] == EXPOSURE_START].astype(np.int64), seen.frame_t)


def _assert_exposures(starts_us: Any, frame_t: Any) -> None:
    """Each frame begins with an exposure; a client may be further with its frames than with its triggers, or behind."""
    both = min(len(starts_us), len(frame_t))
    assert both >= 3
    assert starts_us[:both].tolist() == frame_t[:both].tolist()


def _assert_read_by_its_own_library(path: Path, seen: Seen) -> None:
    reader = dv_processing.io.MonoCameraRecording(str(path))
    assert (reader.getCameraName(), reader.getEventResolution(), reader.getFrameResolution()) == (NAME, SIZE, SIZE)
    frames = []
    while (frame := reader.getNextFrame()) is not None:
        frames.append(frame)
    assert [frame.timestamp for frame in frames] == seen.frame_t.tolist()
    assert all(np.array_equal(frame.image, pixels) for frame, pixels in zip(frames, seen.frames, strict=True))
