"""Base of the pixel methods: light frames in, threshold crossings out, and stated capabilities."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame
from emulator.sensor.pixels.crossings import Crossings
from emulator.sensor.pixels.state import Levels
from emulator.sensor.presets import SensorParameters

_Float32s = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]
_Int64s = npt.NDArray[np.int64]

ADJUSTABLE = (
    "threshold_on", "threshold_off", "leak_hz", "refractory_us", "corner_max_hz", "source_follower_hz", "highpass_hz",
)  # fmt: skip
"""Fields of SensorParameters that can change between two steps, where a method is adjustable."""


STOP = np.zeros(1, np.uint8)
"""Flag of the process: above 0 a step of pixels returns after the candidates that it solves, and raises."""


class StepInterrupted(KeyboardInterrupt):
    """End of a run within a step."""


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Stated capabilities of a pixel method.

    Attributes
    ----------
    uses_rate : the time derivative of the light is used.
    refines_pixels : undersampled pixel-steps are refined by the light of single pixels between frames.
    skips_unchanged : resting pixels outside the changed region of a frame are skipped.
    is_adjustable : parameters can change between two steps: `adjust`, `thresholds_of`.
    takes_row_reads : reads of active pixels can disturb the pixels: `levels`.
    has_faults : pixels can be dead, and their leak can change between two steps: `kill`, `leak_hz`, `set_leak`.
    has_comparator : the comparator's delay, its noise as first passages, the high-pass, and offset and noise of resets.
    has_grid_noise, has_large_signal, has_circuit : noise of grade "grid", the large-signal photoreceptor, its circuit.
    """

    uses_rate: bool = False
    refines_pixels: bool = False
    skips_unchanged: bool = False
    is_adjustable: bool = False
    takes_row_reads: bool = False
    has_faults: bool = False
    has_grid_noise: bool = False
    has_large_signal: bool = False
    has_comparator: bool = False
    has_circuit: bool = False

    def check(self, parameters: SensorParameters) -> None:
        """Raise ValueError if the parameters switch on an effect that needs another method."""
        if parameters.photoreceptor == "large_signal" and not self.has_large_signal:
            raise ValueError('photoreceptor = "large_signal" needs evstim\'s own pixels: leave it out, or the method')
        if (parameters.photoreceptor == "circuit") != self.has_circuit:
            raise ValueError('photoreceptor = "circuit" is a method of its own: leave it out, or the other method')
        if parameters.noise.rms and parameters.noise.grade == "grid" and not self.has_grid_noise:
            raise ValueError('noise.grade = "grid" is a method of its own: leave it out, or the other method')
        comparator, reset = parameters.comparator, parameters.reset
        noise = 0.0 if self.has_grid_noise else parameters.noise.rms
        behind = comparator.on_us, comparator.off_us, abs(reset.offset), reset.noise
        if max(noise, parameters.highpass_hz, *behind) and not self.has_comparator:
            raise ValueError(
                "noise.rms, highpass_hz, comparator.on_us, off_us, reset.offset, reset.noise need evstim's own pixels:"
                " set them to 0, or leave out the method"
            )


class PixelMethod(ABC):
    """An array of pixels that turn light frames into crossings.

    Parameters
    ----------
    parameters : the sensor.
    seed : keys the pixels: all methods have the same thresholds, leak rates and leak phases for one seed.

    Attributes
    ----------
    capabilities : of the class. A method that lacks one raises NotImplementedError from the functions that it names.
    lost_in_pixel : crossings since `reset` beyond the most that a pixel can have in a step.
    quiet_nan : pixel-steps since `reset` whose light was NaN or infinite.
    """

    capabilities: ClassVar[Capabilities] = Capabilities()

    def __init__(self, parameters: SensorParameters, seed: int) -> None:
        self.parameters, self.seed = parameters, seed
        self.lost_in_pixel = self.quiet_nan = 0

    @property
    @abstractmethod
    def settled_ns(self) -> int:
        """Stream time up to which all crossings have been returned."""

    @property
    def undersampled_share(self) -> float | None:
        """Undersampled pixel-steps over those that had to be solved; None where unknown."""
        return None

    @abstractmethod
    def reset(self, frame: LightFrame) -> None:
        """Start at rest on the light of `frame`, at its time, with counters at zero."""

    @abstractmethod
    def step(self, frame: LightFrame) -> Crossings:
        """Move from the last frame to this one and return the crossings on the way.

        Parts of a frame for which the method states no capability are ignored. Raises ValueError if time goes back, or
        the frame does not have the sensor's size.
        """

    @property
    def adjustable(self) -> dict[str, float]:
        """Fields of `parameters` that `adjust` can change, with their present values; {} where there is none."""
        if not self.capabilities.is_adjustable:
            return {}
        fixed = () if self.parameters.source_follower_hz > 0 else ("source_follower_hz",)
        return {name: float(getattr(self.parameters, name)) for name in ADJUSTABLE if name not in fixed}

    def adjust(self, name: str, value: float) -> None:
        """Set one of `adjustable` from the present time on; raises ValueError where the value is not allowed."""
        raise NotImplementedError

    def thresholds_of(self, pixel: int) -> tuple[float, float]:
        """Return the ON and OFF threshold of one pixel as they are now; infinite for a dead one."""
        raise NotImplementedError

    def levels(self) -> Levels:
        """Return the access to the comparators' levels."""
        raise NotImplementedError

    def kill(self, pixel: _Int64s) -> None:
        """Make pixels, (n,), dead; before `reset`. The caller must discard their crossings."""
        raise NotImplementedError

    def leak_hz(self) -> _Floats:
        """Return the leak rate of all pixels, (pixels,), without the parasitic leak."""
        raise NotImplementedError

    def set_leak(self, leak_hz: _Floats) -> None:
        """Set the leak rate of all pixels, (pixels,), from the present time on."""
        raise NotImplementedError

    def _flat(self, values: _Float32s) -> _Float32s:
        """Return light or its derivative, (height, width) float32, as (pixels,); raises ValueError for other arrays."""
        size = (self.parameters.height, self.parameters.width)
        if values.shape != size or values.dtype != np.float32:
            raise ValueError(f"light or rate is {values.shape} {values.dtype}: must be {size} float32")
        return np.ascontiguousarray(values).reshape(-1)


def time_of(frame: LightFrame, last_ns: int) -> int:
    """Return the time of a frame; raises ValueError if it is before the last frame's, `last_ns`."""
    if frame.t_ns < last_ns:
        raise ValueError(f"t_ns = {frame.t_ns}: before the last step's {last_ns}; time does not go back")
    return int(frame.t_ns)


MakePixels = Callable[[SensorParameters, int], PixelMethod]
"""Factory of a sensor's pixels, from its parameters and a seed."""
