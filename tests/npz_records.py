"""Streams of an `.npz` record, read by numpy: each with the indices of clock restarts."""

import numpy as np

from firmware_protocol.events import EDGE
from firmware_protocol.recordings.part import IMU
from transports.recording.record import frame_record


def save_record(path, events, resets):
    """Write events (n,) in device time and the indices of clock restarts; no edges."""
    with open(path, "wb") as file:
        np.savez(file, events=events, resets=np.array(resets, np.int64))


def load_edges(path):
    return _stream(path, "edges", "edge_resets", EDGE)


def load_imu(path):
    return _stream(path, "imu", "imu_resets", IMU)


def load_frames(path):
    return _stream(path, "frames", "frame_resets", frame_record((0, 0)))


def _stream(path, name, resets, dtype):
    with np.load(path) as arrays:
        if name not in arrays:
            return np.zeros(0, dtype), []
        return arrays[name], arrays[resets].tolist()
