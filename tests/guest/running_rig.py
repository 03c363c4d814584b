"""`evstim run` on the host, as a user starts it, and the record of what it delivered."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_protocol.events import Edges, Events
from tests.npz_records import load_edges, load_frames, load_imu
from transports.recording.record import load_record

__all__ = ["CHECKERBOARD", "CHECKERBOARD_240C", "Delivered", "RunningRig"]

START_TIMEOUT_S = 240.0
STOP_TIMEOUT_S = 120.0
CHECKERBOARD = """
title = "A moving checkerboard, served over USB/IP to a guest"

[scene]
kind = "checkerboard"
speed_px_s = 10.0         # some 0.3 million events a second, which a processor that QEMU translates can take

[camera]
speed = "{speed}"
layout = "{layout}"
start_delay_ms = 1000.0   # neuromorphic_drivers must have started all its transfers; a guest on a busy machine is slow

[[links]]
kind = "usbip"
port = {port}
"""
CHECKERBOARD_240C = CHECKERBOARD.replace("[camera]", '[camera]\nmodel = "davis240c"')


@dataclass(frozen=True)
class Delivered:
    """What left the camera, in device time, and where that time started anew: events (n,) EVENT, edges (m,) EDGE, IMU
    samples (k,) IMU, and frames (f,) of `frame_record`.
    """

    events: Events
    resets: list[int]
    edges: Edges
    edge_resets: list[int]
    imu: np.ndarray
    imu_resets: list[int]
    frames: np.ndarray
    frame_resets: list[int]

    @property
    def last(self):
        """The events since device time started anew the last time."""
        return self.events[self.resets[-1] :]

    @classmethod
    def load(cls, record):
        """Read a record."""
        return cls(*load_record(record), *load_edges(record), *load_imu(record), *load_frames(record))

    @property
    def turns(self):
        """Split where device time started anew."""
        events, edges, imu, frames = (
            np.split(told, resets[1:] or [len(told)] * (len(self.resets) - 1))
            for told, resets in (
                (self.events, self.resets),
                (self.edges, self.edge_resets),
                (self.imu, self.imu_resets),
                (self.frames, self.frame_resets),
            )
        )
        parts = zip(events, edges, imu, frames, strict=True)
        return [Delivered(part[0], [0], part[1], [0], part[2], [0], part[3], [0]) for part in parts]


class RunningRig:
    """A rig that serves its camera until the block ends; `summary`, which must balance, and `delivered` are then known.

    Parameters
    ----------
    folder
        Existing folder for the rig file, the record and what the program says.
    speed
        The camera's USB speed, "super" or "high".
    layout
        How its chip lies, "upright" or "turned".
    more
        Further tables of the rig.
    text
        The rig, with {port}, {speed} and {layout} in it.
    """

    limit_s = 7200.0
    """Stream time; should the tests be killed, the run ends by itself."""

    def __init__(self, folder, speed="super", layout="upright", more="", text=CHECKERBOARD):
        self._camera = {"speed": speed, "layout": layout}
        self._text = text + more
        self._record = folder / "delivered.npz"
        self._said = folder / "evstim.log"
        self._rig = folder / "guest.toml"
        self.port = _free_port()
        self.summary = {}

    def __enter__(self):
        self._rig.write_text(self._text.format(port=self.port, **self._camera))
        program = Path(sys.executable).with_name("evstim")
        command = [str(program), "run", str(self._rig), "--record", str(self._record), "--json"]
        command += ["--seconds", str(self.limit_s)]
        with self._said.open("w") as said:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT)
        try:
            self._wait_until_served()
        except BaseException:
            self._process.kill()
            self._process.wait()
            raise
        return self

    def __exit__(self, kind, error, at):
        self.stop()
        assert kind or self.summary["balanced"], self.summary

    def stop(self):
        """End the run as Ctrl-C does; calling it again does nothing."""
        if self._process.returncode is not None:
            return
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(STOP_TIMEOUT_S)
        finally:
            self._process.kill()
            self._process.wait()
        last_line = self.said.splitlines()[-1]
        try:
            self.summary = json.loads(last_line)
        except ValueError as error:
            raise RuntimeError(f"evstim run did not end with its summary:\n{self.said}") from error

    @property
    def said(self):
        """All that the program printed."""
        return self._said.read_text(errors="replace")

    @property
    def delivered(self):
        """The record; only after the end of the run."""
        return Delivered.load(self._record)

    def _wait_until_served(self):
        deadline = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline:
            if self._process.poll() is not None:
                raise RuntimeError(f"evstim run ended at once:\n{self.said}")
            try:
                socket.create_connection(("127.0.0.1", self.port)).close()
            except ConnectionRefusedError:
                time.sleep(0.05)
            else:
                return
        raise TimeoutError(f"evstim run does not serve:\n{self.said}")


def _free_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]
