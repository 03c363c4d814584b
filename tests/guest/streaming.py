"""A driver's client at work in the guest, and what it saw."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_protocol.events import Edges, Events
from tests.guest.comparison import load_frames, load_imu, load_seen, load_triggers
from tests.guest.environments import Driver

__all__ = ["STREAM_TIMEOUT_S", "Seen", "Streaming", "read", "read_until_pulled", "wait_for_bytes"]

STREAM_TIMEOUT_S = 240.0
OPEN_TIMEOUT_S = 240.0


@dataclass(frozen=True)
class Seen:
    """What a client tells of the camera, in its own time: events (n,) EVENT, triggers (m,) EDGE, samples and frames.

    `imu_t` (k,) and `imu` (k, 7): acceleration in g, temperature in degrees Celsius, rate in deg/s.
    `frame_t` (f,) and `frames` (f, height, width): as the driver gives them.
    `said`: all that the client printed, its driver's log too.
    """

    driver: Driver
    about: dict[str, Any]
    events: Events
    triggers: Edges
    imu_t: np.ndarray
    imu: np.ndarray
    frame_t: np.ndarray
    frames: np.ndarray
    said: str = ""


class Streaming:
    """One run of a client: it opens the camera, takes `count` events or what comes in time, and closes it."""

    def __init__(self, guest, driver, python, count, *options, timeout_s=STREAM_TIMEOUT_S):
        self._guest = guest
        self._driver = driver
        self._output = guest.results / f"{driver.name}.npz"
        self._started = self._output.with_suffix(".started")
        self._started.unlink(missing_ok=True)
        limits = ["--count", str(count), "--timeout", str(timeout_s), *driver.options]
        output = ["--output", guest.path_in_guest(self._output.name)]
        guest.prepare(python, driver.imports)
        self._job = guest.start(
            [str(python), str(driver.program), *limits, *output, *options], timeout_s + STREAM_TIMEOUT_S
        )

    def wait_until_started(self):
        """Wait for the client's first events; raises TimeoutError."""
        deadline = time.monotonic() + OPEN_TIMEOUT_S
        while not self._started.exists():
            if time.monotonic() > deadline:
                raise TimeoutError(f"no events within {OPEN_TIMEOUT_S} s: {self._job.wait()}")
            time.sleep(0.02)

    def wait(self):
        """Wait for the end; raises RuntimeError with all that the client said when it failed."""
        finished = self._job.wait()
        about = _last_object(finished.stdout)
        if not (finished.ok or self._may_abort(finished, about)):
            raise RuntimeError(f"{finished}\nconsole of the guest:\n{self._guest.console}")
        streams = load_seen(self._output), load_triggers(self._output)
        return Seen(self._driver, about, *streams, *load_imu(self._output), *load_frames(self._output), str(finished))

    def _may_abort(self, finished, about):
        known = self._driver.abort_after_unplugging
        may_abort = about.get("running") is False or not self._driver.stops_camera
        return bool(known) and known in finished.stderr and may_abort


def read(guest, driver, python, count, *options, **limits):
    """Return what a client saw; raises AssertionError where that are fewer events than it was asked for."""
    seen = Streaming(guest, driver, python, count, *options, **limits).wait()
    assert len(seen.events) >= count, seen.about
    return seen


def read_until_pulled(camera, *client, **limits):
    """Pull the cable while a client streams, see `read`; return what it saw, and what the kernel told of the camera."""
    with camera:
        streaming = Streaming(*client, "--on", **limits)
        streaming.wait_until_started()
    cut = streaming.wait()
    assert cut.about["running"] is False
    assert len(cut.events) >= client[3], cut.about
    return cut, camera.device


def wait_for_bytes(file, timeout_s):
    """Wait until a client of another kind wrote its first events; raises TimeoutError."""
    deadline = time.monotonic() + timeout_s
    while not (file.exists() and file.stat().st_size):
        if time.monotonic() > deadline:
            raise TimeoutError(f"{file.name} is empty after {timeout_s} s")
        time.sleep(0.02)


def _last_object(stdout):
    """Read the JSON object on the last line; empty when the client came to an end before it could print one."""
    lines = stdout.splitlines()
    if not lines or not lines[-1].startswith("{"):
        return {}
    return json.loads(lines[-1])
