"""Parts of a recording, in the time of the camera's clock, from what a link delivered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.event_copies import copy_events
from firmware_protocol.events import Events, empty_events
from firmware_protocol.frame_assembly import FrameAssembler, WholeFrame
from firmware_protocol.imu_samples import ImuSamples, no_samples, physical
from firmware_protocol.readings import Reading, ReadingKind
from transports.recording.part import IMU, Frame, Part

__all__ = ["Delivered", "DeliveredParts", "recorded_imu"]


@dataclass(frozen=True)
class Delivered:
    """Events (n,) EVENT, edges (m,) EDGE and readings that left together, in the time told to the device."""

    events: Events = field(default_factory=empty_events)
    edges: Edges = field(default_factory=empty_edges)
    readings: Sequence[Reading] = ()


class DeliveredParts:
    """Makes parts, and frames of their lines.

    Parameters
    ----------
    imu_unit
        Type of the inertial unit, for its temperature.

    Attributes
    ----------
    frame_records
        How many readings each frame was made of, in the order in which they were complete.
    """

    def __init__(self, imu_unit: int) -> None:
        self._imu_unit = imu_unit
        self._frames = FrameAssembler()
        self.frame_records: list[int] = []

    def part(self, delivered: Delivered, epoch_us: int) -> Part:
        """Return copies of what was delivered, less `epoch_us`, at which the device's clock was zero.

        `epoch_us` is negative where that was before the run.
        """
        imu = recorded_imu(_imu_of(delivered.readings), self._imu_unit)
        events, edges = copy_events(delivered.events), delivered.edges.copy()
        for records in (events, edges, imu):
            if len(records):
                records["t"] -= np.uint64(epoch_us % (1 << 64))
        frames = self._frames.add(tuple(delivered.readings))
        self.frame_records += [frame.records for frame in frames]
        return Part(events, edges, imu, tuple(_frame(frame, epoch_us) for frame in frames))


def recorded_imu(samples: ImuSamples, unit: int) -> npt.NDArray[np.void]:
    """Return samples, (n,) IMU_SAMPLE of a unit (1 or 2), as recordings have them, (n,) IMU."""
    out = np.zeros(len(samples), IMU)
    if not len(samples):
        return out
    in_units = physical(samples, unit)
    out["t"], out["temperature"] = in_units["t"], in_units["temperature_c"]
    for k, axis in enumerate("xyz"):
        out[f"accelerometer_{axis}"] = in_units["acceleration_g"][:, k]
        out[f"gyroscope_{axis}"] = in_units["rate_deg_s"][:, k]
    return out


def _imu_of(readings: Sequence[Reading]) -> ImuSamples:
    return np.concatenate([no_samples(), *(one.record for one in readings if one.kind is ReadingKind.IMU)])


def _frame(frame: WholeFrame, epoch_us: int) -> Frame:
    """Return a frame for a recording: dated by the start of its exposure, as drivers do, and not before time zero.

    The clock may have started anew during the exposure.
    """
    begin_us, end_us = (max(0, t_us - epoch_us) for t_us in (frame.exposure_start_us, frame.exposure_end_us))
    return Frame(begin_us, begin_us, end_us, frame.pixels, (frame.first_column, frame.first_row))
