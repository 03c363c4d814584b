"""The rig table of a scene that an external renderer draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from emulator.scene.kind import SceneKind
from emulator.trajectory.parameters import TrajectoryParameters
from firmware_protocol.bounds import check_bounds
from transports.network import check_allow


@dataclass(frozen=True)
class ExternalParameters:
    """Images of another program, a renderer, which connects to evstim; `evstim.renderer` is its side.

    Attributes
    ----------
    host : address to listen on.
    port : TCP port to listen on.
    allow : addresses and networks that may connect; needed where `host` can be reached from other machines.
    images
        "requested": evstim gives the time of each image, every `period_ms`. "pushed": the renderer does, and
        its first image has time 0.
    period_ms : time from one requested image to the next.
    ahead : images requested in advance, which the renderer draws while evstim computes.
    delay_ms
        Of pushed images: stream time at which the first one is shown. In real time, more than the renderer takes.
    white_w_m2_sr
        Radiance of the value 1 or of the level of white, W m-2 sr-1; 30 for ground of albedo 0.07 in sunlight.
    camera : path of the camera, sent with each request; without it the renderer moves the camera itself.
    time_scale : speed of that path relative to reality.
    wait_s : time to wait for the renderer at the start.
    timeout_s : longest time to wait for one image.
    """

    kind: ClassVar[str] = "external"
    host: str = "127.0.0.1"
    port: Annotated[int, Meta(ge=1, le=65535)] = 5560
    allow: tuple[str, ...] = ()
    images: Literal["requested", "pushed"] = "requested"
    period_ms: Annotated[float, Meta(ge=0.001, le=60_000)] = 10.0
    ahead: Annotated[int, Meta(ge=0, le=16)] = 1
    delay_ms: Annotated[float, Meta(ge=0, le=10_000)] = 0.0
    white_w_m2_sr: Annotated[float, Meta(ge=1e-12, le=1e9)] = 30.0
    camera: TrajectoryParameters | None = None
    time_scale: Annotated[float, Meta(ge=1e-6, le=1e6)] = 1.0
    wait_s: Annotated[float, Meta(ge=0.1, le=3600)] = 60.0
    timeout_s: Annotated[float, Meta(ge=0.1, le=600)] = 5.0

    def __post_init__(self) -> None:
        check_bounds(self)
        check_allow(self.host, self.allow)
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
