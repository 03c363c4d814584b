"""Three unmodified drivers see every pixel of every frame, with events at the same time, in both layouts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming
from transports.recording.record import load_frames

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200), pytest.mark.xdist_group("guest")]

EVENTS = 200_000
FRAMES = "\n[camera.frames]\nsensitivity_dn_ms = 20.0  # dv-processing exposes for 20 ms\n"


def as_seen(driver: Driver, reset_less_signal: np.ndarray) -> np.ndarray:
    """What a driver's picture is, of pixels of 10 bits, within a step of 8 bits where it rounds."""
    return reset_less_signal << 6 if driver.name == "nd" else np.minimum(reset_less_signal / 4, 255)


@pytest.mark.parametrize("layout", ["turned", "upright"])
@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_every_pixel_of_every_frame_is_seen(
    guest: Guest, driver: Driver, layout: str, driver_pythons: dict[str, Path], tmp_path: Path
) -> None:
    with RunningRig(tmp_path, layout=layout, more=FRAMES) as rig, Attachment(guest, rig.port):
        seen = Streaming(guest, driver, driver_pythons[driver.name], EVENTS, "--frames").wait()
    delivered = rig.delivered
    events = delivered.events[delivered.resets[-1] :]
    offset_us = int(seen.events["t"][0]) - int(events["t"][0]) if driver.adds_host_time else 0
    assert_same(seen.events, events, offset_us=offset_us)
    frames = load_frames(tmp_path / "delivered.npz")
    with np.load(guest.results / f"{driver.name}.npz") as arrays:
        got, times = arrays["frames"], arrays["frame_t"] - offset_us
    assert len(got) >= 3
    ours = frames["t"] if driver.adds_host_time else frames["exposure_end"]
    first = int(np.argmin(np.abs(ours - times[0])))
    for k, pixels in enumerate(got):
        expected = as_seen(driver, frames["pixels"][first + k].astype(np.int64))
        most = 0 if driver.name == "nd" else 1
        assert np.abs(pixels.astype(np.int64) - expected).max() <= most, k
    assert rig.summary["balanced"], rig.summary
