"""The record of one kind of scene: its table in a rig, and what builds it.

A package outside evstim gives a record as an entry point of the group "evstim.scenes".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

from transports.needs import Need

__all__ = ["SceneKind", "SceneParameters"]


class SceneParameters(Protocol):
    """A [scene] table of a rig: a frozen dataclass with the name of its kind."""

    kind: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]


def _nothing(_: SceneParameters) -> tuple[Need, ...]:
    return ()


@dataclass(frozen=True)
class SceneKind:
    """One kind of scene.

    Attributes
    ----------
    parameters
        Type of its [scene] table; its `kind` is the kind's name.
    build
        Import path, "module:name", of what returns the `emulator.light.Scene`; imported when a scene is built. It is
        called with the parameters and what `lens` says.
    lens
        What becomes of the camera's lens. "none": the scene brings its own light, build(parameters, size). "applied":
        the scene is in units of radiance and seen through the lens, build(parameters, pinhole). "own": the scene does
        what the lens does, build(parameters, size, lens, chip).
    events
        Import path of what takes the sensor's place, called with the parameters and the sensor's; "": the sensor sees
        the scene.
    kernels
        Whether drawing it compiles kernels, which a run does ahead.
    gl
        Import path of what builds it drawn by GL, called as `build` is; "": the CPU alone draws it.
    needs
        What a scene of these parameters needs of the machine, beyond evstim and its base dependencies.
    """

    parameters: type[SceneParameters]
    build: str
    lens: Literal["none", "applied", "own"] = "none"
    events: str = ""
    kernels: bool = True
    gl: str = ""
    needs: Callable[[Any], tuple[Need, ...]] = _nothing

    def __post_init__(self) -> None:
        if not isinstance(getattr(self.parameters, "kind", None), str):
            raise ValueError("the parameters of a scene need a class attribute `kind`")

    @property
    def name(self) -> str:
        """What rigs write as `kind`."""
        return self.parameters.kind
