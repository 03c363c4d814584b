"""From a rig to the parts of a run."""

from __future__ import annotations

from pathlib import Path

from emulator.rig import LinkParameters, LoopbackLink, Rig, SceneParameters
from emulator.scene.base import Scene
from emulator.scene.checkerboard import Checkerboard, CheckerboardParameters
from emulator.session import Schedule
from firmware_protocol.davis346 import Davis346Settings, Layout
from firmware_protocol.usb.device import Speed
from transports.link import EndpointFactory, LinkSetup
from transports.loopback import LoopbackFactory
from transports.ring import EventRing
from transports.usbip.endpoint import UsbipFactory

__all__ = ["build_scene", "link_setups", "record_paths", "schedule"]


def build_scene(parameters: SceneParameters, size: tuple[int, int]) -> Scene:
    """Return the scene at `size` = (width, height) pixels; raises SceneError."""
    if isinstance(parameters, CheckerboardParameters):
        return Checkerboard(parameters, size)
    from emulator.scene.body import Body  # here, so that a rig without a mesh needs no GL library

    return Body(parameters, size)


def schedule(rig: Rig) -> Schedule:
    """Return how the rig's run goes through time."""
    run = rig.run
    return Schedule(
        step_ns=run.step_us * 1000,
        lead_ns=run.lead_us * 1000,
        duration_ns=round(run.seconds * 1e9) or None,
        paced=run.pace == "realtime",
    )


def record_paths(rig: Rig, record: Path | None) -> list[Path | None]:
    """Return where each link records: the file asked for, with the link's name in it when there are several."""
    if record is None or len(rig.links) == 1:
        return [record] * len(rig.links)
    return [record.with_name(f"{record.stem}-{link.name}{record.suffix}") for link in rig.links]


def link_setups(rig: Rig, record: Path | None = None) -> list[LinkSetup]:
    """Return what each link's process needs."""
    return [
        LinkSetup(link.name, EventRing(), _camera(rig, link), _endpoint(link), path)
        for link, path in zip(rig.links, record_paths(rig, record), strict=True)
    ]


def _camera(rig: Rig, link: LinkParameters) -> Davis346Settings:
    camera = rig.camera
    # The loopback host never loses its way at the start, so it need not wait.
    delay_ms = 0.0 if isinstance(link, LoopbackLink) else camera.start_delay_ms
    return Davis346Settings(
        serial=camera.serial,
        size=(camera.sensor.width, camera.sensor.height),
        speed=Speed[camera.speed.upper()],
        layout=Layout[camera.layout.upper()],
        fifo_bytes=camera.fifo_bytes,
        start_delay_us=round(delay_ms * 1000),
    )


def _endpoint(link: LinkParameters) -> EndpointFactory:
    if isinstance(link, LoopbackLink):
        return LoopbackFactory()
    return UsbipFactory(link.host, link.port, link.busid)
