"""The record of one kind of scene: its table in a rig, and the function that builds it.

A package outside evstim gives a record as an entry point of the group "evstim.scenes". `Blank` is the scene of a rig
whose events come from another source.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

import numpy as np

from emulator.light import NOTHING, LastArrays, Light, Scene
from transports.needs import Need


class SceneParameters(Protocol):
    """A [scene] table of a rig: a frozen dataclass with the name of its kind."""

    kind: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]


@dataclass(frozen=True)
class SceneKind:
    """One kind of scene.

    Attributes
    ----------
    parameters : type of its [scene] table; its `kind` is the kind's name.
    build
        Import path, "module:name", of the function that returns the `emulator.light.Scene`; imported when a scene is
        built. Its arguments are the parameters and those that `lens` requires.
    lens
        Use of the camera's lens. "none": the scene gives the light on the sensor, build(parameters, size). "applied":
        the scene is in units of radiance and seen through the lens, build(parameters, pinhole). "own": the scene
        models the lens itself, build(parameters, size, lens, chip).
    events
        Import path of a source of events that replaces the sensor, called with the parameters and the sensor's; "": the
        sensor receives the light of the scene.
    kernels : True: drawing compiles kernels, which a run does in advance.
    gl
        Import path of the function that builds the scene for GL, with the arguments of `build`; "": only the CPU draws
        it.
    threads : True: `build` takes the keyword `threads`, the number of threads that draw, 0 for its own choice.
    needs : function from the parameters to the needs of the scene beyond evstim and its base dependencies.
    """

    parameters: type[SceneParameters]
    build: str
    lens: Literal["none", "applied", "own"] = "none"
    events: str = ""
    kernels: bool = True
    gl: str = ""
    threads: bool = False
    needs: Callable[[Any], tuple[Need, ...]] = lambda _: ()

    def __post_init__(self) -> None:
        if not isinstance(getattr(self.parameters, "kind", None), str):
            raise ValueError("the parameters of a scene need a class attribute `kind`")

    @property
    def name(self) -> str:
        """Name of the kind, the key `kind` in rigs."""
        return self.parameters.kind


NO_RATE = np.zeros((0, 0), np.float32)
"""In place of a rate that is not needed."""


class SizedScene(Scene):
    """A scene of `size` = (width, height) pixels with a rate; its `_arrays` are for what it draws."""

    has_rate = True

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self._arrays = LastArrays()

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at `t_ns`: `light_and_rate` gets NO_RATE."""
        self.light_and_rate(t_ns, out, NO_RATE)

    def close(self) -> None:
        """Do nothing, unless a kind of scene holds resources."""


class Blank(SizedScene):
    """Darkness."""

    motion_bound_px_s = 0.0

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write zeros, unless these are the arrays of the last call."""
        self.changed = NOTHING if self._arrays.are(light, rate) else None
        if self.changed is None:
            light.fill(0)
            rate.fill(0)
