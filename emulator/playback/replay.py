"""A recording in the sensor's place: the same calls as `Sensor`, with events from a file.

Stream time t shows the recorded time t * time_scale; a loop restarts one mean gap after the last event, so that no
two rounds share an instant. The result does not depend on the step.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np

from emulator.light import LightFrame
from emulator.playback.recording import RecordingParameters, load_recording
from emulator.scene.kind import Blank
from emulator.sensor.chip.readout import ArbiterReadOut
from emulator.sensor.parameters import KickParameters
from emulator.sensor.pixels.crossings import Crossings
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import EVENT, Events, Int64s, copy_events, join_events

_NS = 1000


class Replay:
    """Playback of `recording`, (n,) EVENT from time 0, sorted and inside the sensor, by a rig's table."""

    undersampled_share: float | None = None
    lost_in_pixel = 0

    def __init__(self, parameters: SensorParameters, recording: Events, table: RecordingParameters) -> None:
        self.parameters = parameters
        self._recording = recording
        scale = Fraction(repr(float(table.time_scale)))
        # Times are stream time in ns from here on: recorded us * 1000 / scale, rounded down.
        self._t_ns = recording["t"].astype(np.int64) * (_NS * scale.denominator) // scale.numerator
        gap_ns = max(_NS, int(self._t_ns[-1]) // max(1, len(recording) - 1))
        self._round_ns = int(self._t_ns[-1]) + gap_ns if table.loop else None
        self._readout = ArbiterReadOut(parameters) if table.through_readout else None
        self._next = self._start_ns = 0
        self.raised = 0

    @property
    def lost_at_readout(self) -> int:
        """Events that found their pixel's request still waiting."""
        return 0 if self._readout is None else self._readout.lost_at_readout

    @property
    def read_out(self) -> int:
        """Events returned so far."""
        return self.raised if self._readout is None else self._readout.read_out

    def with_kicks(self, kicks: KickParameters) -> None:
        """Return None: recorded events are not disturbed by the reading of frames."""

    def warm_up(self) -> None:
        """Nothing is compiled."""

    def reset(self, frame: LightFrame) -> None:
        """Start at the time of `frame`; its light has no effect."""
        self._next = 0
        self._start_ns = int(frame.t_ns)
        self.raised = 0

    def expose(self, frame: LightFrame) -> Events:
        """Return the events up to the time of `frame`; its light has no effect."""
        t_ns = int(frame.t_ns)
        pieces = [self._round(t_ns)]
        while self._next == len(self._recording) and self._round_ns is not None:
            if self._start_ns + self._round_ns > t_ns:
                break
            self._next, self._start_ns = 0, self._start_ns + self._round_ns
            pieces.append(self._round(t_ns))
        times = pieces[0][0] if len(pieces) == 1 else np.concatenate([t for t, _ in pieces])
        events = join_events([e for _, e in pieces])
        self.raised += len(events)
        return self._leave(times, events, t_ns)

    def finish(self) -> Events:
        """Return the events that still wait at the arbiter."""
        return np.empty(0, EVENT) if self._readout is None else self._readout.finish()

    def _round(self, t_ns: int) -> tuple[Int64s, Events]:
        """Return times and events of the present round up to `t_ns`, and go on behind them."""
        last = int(np.searchsorted(self._t_ns, t_ns - self._start_ns, "right"))
        part = slice(self._next, max(self._next, last))
        self._next = part.stop
        return self._t_ns[part] + self._start_ns, self._recording[part]

    def _leave(self, times: Int64s, events: Events, t_ns: int) -> Events:
        if self._readout is None:
            out = copy_events(events)
            out["t"] = times.view(np.uint64) // np.uint64(_NS)
            return out
        pixel = events["y"].astype(np.uint32) * np.uint32(self.parameters.width) + events["x"]
        return self._readout.push(Crossings(times, pixel, np.ascontiguousarray(events["on"])), t_ns)


def replay(parameters: RecordingParameters, sensor: SensorParameters) -> Replay:
    """Return the recording of a rig in the place of `sensor`; raises SceneError when it cannot be used."""
    return Replay(sensor, load_recording(Path(parameters.path), (sensor.width, sensor.height)), parameters)


def blank(parameters: RecordingParameters, size: tuple[int, int]) -> Blank:
    """Return the blank scene of a recording."""
    return Blank(size)
