"""The rig table of a scene that an external renderer draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from emulator.scene.kind import SceneKind
from emulator.trajectory.parameters import TrajectoryParameters
from transports.network import check_allow

__all__ = ["EXTERNAL", "ExternalParameters"]


@dataclass(frozen=True)
class ExternalParameters:
    """Images of another program, a renderer, which connects to evstim; `evstim.renderer` is its side.

    Attributes
    ----------
    host
        Address to listen on.
    port
        TCP port to listen on.
    allow
        Addresses and networks that may connect; needed where `host` can be reached from other machines.
    images
        "requested": evstim gives the time of each image, every `period_ms`. "pushed": the renderer gives the times,
        and time 0 of the stream is that of its first image.
    period_ms
        Time from one requested image to the next.
    ahead
        Images requested in advance, which the renderer draws while evstim computes.
    delay_ms
        Of pushed images: stream time at which the first one is shown. In real time, more than the renderer takes.
    white_w_m2_sr
        Radiance of the value 1 or of the level of white, W m-2 sr-1; 30 for ground of albedo 0.07 in sunlight.
    camera
        Path of the camera, sent with each request; without it the renderer moves the camera itself.
    time_scale
        Speed of that path relative to reality.
    wait_s
        Time to wait for the renderer at the start.
    timeout_s
        Longest time to wait for one image.
    """

    kind: ClassVar[str] = "external"
    host: str = "127.0.0.1"
    port: int = 5560
    allow: tuple[str, ...] = ()
    images: Literal["requested", "pushed"] = "requested"
    period_ms: float = 10.0
    ahead: int = 1
    delay_ms: float = 0.0
    white_w_m2_sr: float = 30.0
    camera: TrajectoryParameters | None = None
    time_scale: float = 1.0
    wait_s: float = 60.0
    timeout_s: float = 5.0

    def __post_init__(self) -> None:
        check_allow(self.host, self.allow)
        bounds = {
            "port": (1, 65535),
            "period_ms": (0.001, 60_000.0),
            "ahead": (0, 16),
            "delay_ms": (0.0, 10_000.0),
            "white_w_m2_sr": (1e-12, 1e9),
            "time_scale": (1e-6, 1e6),
            "wait_s": (0.1, 3600.0),
            "timeout_s": (0.1, 600.0),
        }
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} is {getattr(self, name):g}: it must be {low:g} to {high:g}")
        if self.images == "pushed" and self.camera is not None:
            raise ValueError('camera: the pose is sent with requests; with images = "pushed" there are no times for it')

    @property
    def period_ns(self) -> int:
        """Time from one requested image to the next, ns."""
        return round(self.period_ms * 1e6)

    @property
    def slots(self) -> int:
        """Number of images that are requested at a time, each into a slot of its own."""
        return max(1, self.ahead)


EXTERNAL = SceneKind(
    ExternalParameters, "emulator.scene.external.external:open_external", lens="applied", kernels=False, threads=True
)
