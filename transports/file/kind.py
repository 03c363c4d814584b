"""The table and the record of links that write a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from transports.link.endpoint import EndpointFactory
from transports.link.kind import CameraFacts, LinkKind, Unsuitable, Wiring
from transports.needs import Need, package
from transports.recording.format import format_to_write
from transports.recording.part import Facts, RecordingError

__all__ = ["FILE", "FileLink"]


@dataclass(frozen=True)
class FileLink:
    """A recording of all that the camera sends and the format can hold, written while the run goes on.

    Attributes
    ----------
    path
        The file, relative to where evstim is started; its suffix gives the format. What was there is written over.
        Where the camera's clock starts anew, NAME-clock2.SUFFIX follows; a link that was started again
        (`run.restart_links`) writes NAME-restart1.SUFFIX.
    format
        Name of the format where the suffix does not give it; "" for the suffix. See docs/recordings.md.
    camera
        Name of the camera in the file; "" for the model's.
    name
        What this rig calls the link: in reports, and where triggers name it.
    """

    kind: ClassVar[str] = "file"
    path: str = ""
    format: str = ""
    camera: str = ""
    name: str = "file"

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("path is missing: name a file such as events.aedat4")
        try:
            format_to_write(Path(self.path), self.format)
        except RecordingError as error:
            raise ValueError(str(error)) from error


def _endpoint(link: FileLink, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.file.endpoint import FileFactory

    form = format_to_write(Path(link.path), link.format)
    camera = link.camera or wiring.camera.model or "evstim"
    facts = Facts(wiring.camera.size, camera, streams=wiring.camera.streams, imu_unit=wiring.camera.imu_unit)
    return FileFactory(Path(link.path), form, facts)


def _check(link: FileLink, camera: CameraFacts) -> None:
    form = format_to_write(Path(link.path), link.format)
    if camera.size[0] > form.size_px[0] or camera.size[1] > form.size_px[1]:
        most = f"{form.size_px[0]} x {form.size_px[1]}"
        raise Unsuitable(f"{form.title} numbers {most} pixels, not {camera.size}", "path")


def _has_evt(link: FileLink) -> bool:
    return format_to_write(Path(link.path), link.format).name in ("evt2", "evt3", "ros1", "ros2")


def _needs(link: FileLink) -> tuple[Need, ...]:
    needed = format_to_write(Path(link.path), link.format).needs
    return (package(needed),) if needed else ()


FILE = LinkKind(
    FileLink, serves="plain", endpoint=_endpoint, check=_check, has_evt=_has_evt, needs=_needs, has_readings=True
)
