"""An event sensor as a Python object: light frames in, events out."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, TypedDict, Unpack

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame
from emulator.sensor import sensor as simulation
from emulator.sensor.parameters import (
    BackgroundParameters,
    ComparatorParameters,
    DefectParameters,
    ImagerParameters,
    JitterParameters,
    NoiseParameters,
    RadiationParameters,
    ResetParameters,
    TemperatureParameters,
)
from emulator.sensor.presets import PRESETS, ReadoutParameters, SensorParameters
from emulator.tables.typed_table import TableError, convert
from firmware_protocol.bounds import LAST_NS, whole_number
from firmware_protocol.events import Events, Float32s
from transports.registry import unknown

_Part = Mapping[str, Any]


class SensorOptions(TypedDict, total=False):
    """Fields of SensorParameters that differ from a preset's; a part, such as `noise`, as a mapping too."""

    width: int
    height: int
    threshold_on: float
    threshold_off: float
    mismatch: float
    dark_current_relative: float
    corner_hz_at_reference: float
    corner_min_hz: float
    corner_max_hz: float
    leak_hz: float
    leak_spread: float
    parasitic_hz_at_reference: float
    source_follower_hz: float
    highpass_hz: float
    refractory_us: float
    random_start: bool
    photoreceptor: Literal["one_pole", "large_signal", "circuit"]
    readout: ReadoutParameters | _Part
    temperature: TemperatureParameters | _Part
    defects: DefectParameters | _Part
    noise: NoiseParameters | _Part
    background: BackgroundParameters | _Part
    jitter: JitterParameters | _Part
    imager: ImagerParameters | _Part
    radiation: RadiationParameters | _Part
    comparator: ComparatorParameters | _Part
    reset: ResetParameters | _Part


def sensor_parameters(model: str | SensorParameters, **parameters: Unpack[SensorOptions]) -> SensorParameters:
    """Return a preset, or given parameters, with some fields changed.

    Parameters
    ----------
    model : name of a preset, or the parameters to start from.
    parameters : fields to change, see `SensorOptions`.

    Raises
    ------
    ValueError
        A name is unknown or a value is not allowed; the message names it.
    """
    if isinstance(model, str) and model not in PRESETS:
        raise ValueError(f"sensor {unknown(model, list(PRESETS))}")
    table = dataclasses.asdict(PRESETS[model] if isinstance(model, str) else model)
    for key, value in parameters.items():
        part = dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
        table[key] = {**table[key], **part} if isinstance(part, Mapping) and isinstance(table.get(key), dict) else part
    try:
        return convert(table, SensorParameters)
    except TableError as error:
        raise ValueError(f"sensor parameter {'.'.join(map(str, error.path))}: {error}") from error


class Sensor:
    """A simulated event sensor.

    Light is linear, as (height, width) arrays with row 0 on top: 1.0 is the sensor's reference level. Between two
    frames each pixel's photocurrent follows a straight line in its logarithm, so give frames often enough that nothing
    else happens between them.

    Parameters
    ----------
    model : name of a preset ("davis346", "dvxplorer_micro", "imx636", "gen31", "genx320", "ideal"), or
        SensorParameters.
    seed : seed of everything random; the same seed and frames give the same events.
    parameters : fields of SensorParameters, such as `threshold_on=0.2`, `width=64` or `noise={"rms": 0.05}`; see
        `SensorOptions`.

    Attributes
    ----------
    parameters : the sensor's parameters, SensorParameters.

    Raises
    ------
    ValueError
        The model or a field is unknown, or a value is not allowed.
    """

    def __init__(
        self, model: str | SensorParameters = "davis346", *, seed: int = 0, **parameters: Unpack[SensorOptions]
    ) -> None:
        self.parameters = sensor_parameters(model, **parameters)
        self._sensor = simulation.Sensor(self.parameters, whole_number("seed", seed, 0, (1 << 63) - 1))
        self._t_ns: int | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.parameters.width, self.parameters.height

    @property
    def raised(self) -> int:
        """Events raised since `reset`: lost_in_pixel + lost_at_readout + read_out + pending."""
        return self._sensor.raised

    @property
    def lost_in_pixel(self) -> int:
        """Events lost because one pixel had more than 64 in a step."""
        return self._sensor.lost_in_pixel

    @property
    def lost_at_readout(self) -> int:
        """Events lost because an earlier event of their pixel was waiting for the read-out, or their pixel was busy."""
        return self._sensor.lost_at_readout

    @property
    def read_out(self) -> int:
        """Events returned since `reset`."""
        return self._sensor.read_out

    @property
    def pending(self) -> int:
        """Events raised and not yet returned."""
        return self._sensor.pending

    def reset(self, light: npt.ArrayLike, t_ns: int = 0) -> None:
        """Start at `t_ns` at rest on `light`; all counts become zero.

        Parameters
        ----------
        light : (height, width), linear, >= 0.
        t_ns : stream time of this frame, ns, >= 0.
        """
        frame, at_ns = self._light(light), whole_number("t_ns", t_ns, 0, LAST_NS)
        self._sensor.reset(LightFrame(at_ns, frame))
        self._t_ns = at_ns

    def expose(self, light: npt.ArrayLike, t_ns: int, rate: npt.ArrayLike | None = None) -> Events:
        """Move on to the frame `light` at `t_ns` and return the events that leave the sensor until then.

        Parameters
        ----------
        light : (height, width), linear, >= 0, at `t_ns`.
        t_ns : stream time of this frame, ns; later than the one before.
        rate : (height, width), time derivative of the light at `t_ns`, per second, where it is known; the light
            between two frames is then a cubic, for scenes that move smoothly.

        Returns
        -------
        (n,) EVENT: t in us of stream time, x, y, on; sorted by t. A later call, or `finish`, returns an event that the
        read-out has not sent by `t_ns`.
        """
        if self._t_ns is None:
            raise RuntimeError("the sensor has no first frame yet: call reset(light, t_ns) before expose")
        at_ns = whole_number("t_ns", t_ns, 0, LAST_NS)
        if at_ns <= self._t_ns:
            raise ValueError(f"t_ns is {at_ns}: it must be later than the frame before, {self._t_ns} ns")
        if at_ns - self._t_ns > (most_ns := self._sensor.longest_step_ns):
            raise ValueError(
                f"t_ns is {at_ns}: with these parameters a step of more than {most_ns} ns takes minutes or gigabytes: "
                "give frames more often, or lower leak, noise and background"
            )
        slope = None if rate is None else self._frame(rate, "rate")
        events = self._sensor.expose(LightFrame(at_ns, self._light(light), slope))
        self._t_ns = at_ns
        return events

    def finish(self) -> Events:
        """Return the events that the read-out has not sent yet, (n,) EVENT; only `reset` may follow."""
        if self._t_ns is None:
            raise RuntimeError("there is nothing to finish: call reset(light, t_ns) and expose first")
        self._t_ns = None
        return self._sensor.finish()

    def _light(self, light: npt.ArrayLike) -> Float32s:
        frame = self._frame(light, "light")
        if frame.min() < 0:
            row, column = np.unravel_index(int(frame.argmin()), frame.shape)
            raise ValueError(f"light is {frame[row, column]:g} at x = {column}, y = {row}: it must be 0 or more")
        return frame

    def _frame(self, values: npt.ArrayLike, name: str) -> Float32s:
        """Return a frame as the kernels take it; raises TypeError or ValueError with the fault and its place."""
        array, shape = np.asarray(values), (self.parameters.height, self.parameters.width)
        if array.dtype.kind != "f":
            raise TypeError(
                f"{name} is an array of {array.dtype}: linear light in floats is needed, 1.0 being the reference level "
                "(for 8-bit frames use evstim.events_from_frames)"
            )
        if array.shape != shape:
            raise ValueError(f"{name} has the shape {array.shape}: (height, width) = {shape} is needed")
        with np.errstate(over="ignore"):
            frame = np.ascontiguousarray(array, np.float32)
        if not np.isfinite(frame).all():
            row, column = np.argwhere(~np.isfinite(frame))[0]
            raise ValueError(f"{name} is {array[row, column]} at x = {column}, y = {row}: it must be finite")
        return frame
