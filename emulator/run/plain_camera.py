"""What a camera without electronics asks of the rig's frames and inertial unit: there is no host that sets registers.

It asks what drivers ask of a DAVIS346 by default: frames of 4 ms every 40 ms with a global shutter, and all of the
inertial unit at 1 kHz. Beside a link with a host on USB it asks nothing, and gets what that host asks for: there is one
chip, and a recording has no say in what it does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial

from emulator.rig.camera_models import IMU_UNITS
from emulator.rig.link_kinds import LINKS
from emulator.rig.loading import Rig
from emulator.run.stereo import carries_second
from firmware_protocol.davis346.imu_registers import driver_imu_settings
from firmware_protocol.frame_lines import FrameSettings
from firmware_protocol.plain_device import PlainDevice
from firmware_protocol.readings import ReadingKind

__all__ = ["asked_readings", "plain_camera"]

_EXPOSURE_NS, _INTERVAL_NS = 4_000_000, 40_000_000


def asked_readings(rig: Rig) -> Mapping[ReadingKind, tuple[int, ...]]:
    """Return what it asks of each kind of readings that the rig's camera has, as `EventDevice.reading_settings`."""
    has_host = any(LINKS[one.kind].serves == "usb" and not carries_second(rig, one.name) for one in rig.links)
    return {kind: () if has_host else settings for kind, settings in _driver_settings(rig).items()}


def plain_camera(rig: Rig) -> Callable[[], PlainDevice]:
    """Return what makes the device of a link that takes frames and samples, for its process."""
    return partial(PlainDevice, readings=asked_readings(rig))


def _driver_settings(rig: Rig) -> Mapping[ReadingKind, tuple[int, ...]]:
    settings = {}
    if rig.camera.frames is not None:
        width, height = rig.camera.size
        frames = FrameSettings(
            run=True, exposure_ns=_EXPOSURE_NS, interval_ns=_INTERVAL_NS, last_column=width - 1, last_row=height - 1
        )
        settings[ReadingKind.FRAMES] = dataclasses.astuple(frames)
    if rig.camera.imu is not None:
        settings[ReadingKind.IMU] = dataclasses.astuple(driver_imu_settings(IMU_UNITS[rig.camera.imu.unit]))
    return settings
