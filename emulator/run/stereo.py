"""A run's second camera: its rig, its scene from where it is mounted, its sensor, and its ledger.

The first camera's clock is the master of the second one's: see `Timing.sync_out`. Both are drawn at the same instants.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from emulator.light import SceneFrames
from emulator.rig.kinds import CAMERA_MODELS
from emulator.rig.loading import Rig, RigError
from emulator.rig.tables import Camera, SecondCamera
from emulator.run.changes import BiasFollowing, Changes
from emulator.run.outcome import Ledger, LinkLedger
from emulator.run.readings import ReadingSources, StepOutput
from emulator.scene.kind import SceneParameters
from emulator.sensor.sensor import EventSource
from emulator.trajectory.building import MountedPath
from emulator.trajectory.parameters import BasiliskPath, LivePath
from firmware_protocol.events import Events
from transports.link.edges import EdgeRing
from transports.link.process import LinkSetup
from transports.link.report import CameraSettings, LinkReport

__all__ = ["SecondView", "carries_second", "ledger_of", "second_rig", "wired"]

_T = TypeVar("_T")


def carries_second(rig: Rig, link: str) -> bool:
    """Return whether a link carries the rig's second camera."""
    return rig.second_camera is not None and link in rig.second_camera.links


def second_rig(rig: Rig) -> Rig:
    """Return the rig as its second camera has it; raises RigError where its scene has no path to mount it on."""
    second = rig.second_camera
    assert second is not None
    seed = rig.run.seed + 1
    links = tuple(link for link in rig.links if carries_second(rig, link.name))
    run = dataclasses.replace(rig.run, seed=seed)
    return dataclasses.replace(
        rig,
        camera=_second_model(rig.camera, second),
        links=links,
        run=run,
        scene=_moved(rig, second),
        trigger=None,
        second_camera=None,
    )


def _second_model(first: Camera, second: SecondCamera) -> Camera:
    """Return the first camera with another serial number, or one of another model with the same lens and connector."""
    if second.model in ("", first.model):
        return dataclasses.replace(first, serial=second.serial)
    return dataclasses.replace(
        first,
        model=second.model,
        serial=second.serial,
        sensor=CAMERA_MODELS[second.model].sensor,
        imu=None,
        frames=None,
        bias_slopes=None,
        activity_filter=False,
    )


def _moved(rig: Rig, second: SecondCamera) -> SceneParameters:
    path = getattr(rig.scene, "camera", None)
    if path is None or isinstance(path, LivePath | BasiliskPath):
        raise RigError(
            f"{rig.name}: second_camera: this scene's camera has no path of its own on which another can be mounted; "
            "take one of bodies, terrain or stars with a path that the rig gives"
        )
    moved = MountedPath(path, second.offset_m, second.q_first_from_second)
    return dataclasses.replace(rig.scene, camera=moved)


class SecondView:
    """The second camera of a run, step by step.

    Attributes
    ----------
    links : names of the links that carry it.
    """

    def __init__(
        self, frames: SceneFrames, sensor: EventSource, readings: ReadingSources, links: Sequence[str]
    ) -> None:
        self._frames, self._sensor, self._readings = frames, sensor, readings
        self._biases = BiasFollowing(sensor)
        self.links = frozenset(links)

    def begin(self) -> None:
        """Draw the first light frame."""
        frame = self._frames.draw(0)
        self._sensor.reset(frame)
        self._readings.reset(frame)

    def step(self, t_ns: int) -> StepOutput:
        """Move to `t_ns` and return the events and readings until then."""
        frame = self._frames.draw(t_ns)
        readings = self._readings.read(frame)
        return StepOutput(self._sensor.expose(frame), readings)

    def finish(self) -> Events:
        """Return the events that the read-out still holds."""
        return self._sensor.finish()

    def record_in(self, changes: Changes) -> None:
        """Record the changes that its hosts make to its sensor."""
        self._biases.changes = changes

    def follow(self, settings: Mapping[str, CameraSettings], t_ns: int = 0) -> None:
        """Apply the biases that its hosts write to its sensor, which is at stream time `t_ns`."""
        self._biases.follow(self._own(settings), t_ns)

    def ledger(self, reports: Mapping[str, LinkReport]) -> Ledger:
        """Return the fates of its events."""
        return ledger_of(self._sensor, self._own(reports))

    def _own(self, of_links: Mapping[str, _T]) -> dict[str, _T]:
        return {name: one for name, one in of_links.items() if name in self.links}

    def close(self) -> None:
        """Close its scene."""
        self._frames.scene.close()


def wired(slaves: Sequence[str], setups: Sequence[LinkSetup[Any]]) -> list[LinkSetup[Any]]:
    """Return the links with the cable between the cameras: the first link of the first camera is the master's end.

    Each link of the second camera receives the master's resets. Raises RigError where the first camera has no link.
    """
    cables = {name: EdgeRing() for name in slaves}
    master = next((setup.name for setup in setups if setup.name not in cables), None)
    if master is None:
        raise RigError("second_camera: the first camera needs a link too, as the master of the clocks")

    def at_the_cable(setup: LinkSetup[Any]) -> LinkSetup[Any]:
        out = tuple(cables.values()) if setup.name == master else ()
        timing = dataclasses.replace(setup.timing, sync_out=out, sync_in=cables.get(setup.name))
        return dataclasses.replace(setup, timing=timing)

    return [at_the_cable(setup) for setup in setups]


def ledger_of(sensor: EventSource | Ledger, reports: Mapping[str, LinkReport], second: Ledger | None = None) -> Ledger:
    """Return the fates of the events of a sensor over its links."""
    return Ledger(
        raised=sensor.raised,
        lost_in_pixel=sensor.lost_in_pixel,
        lost_at_readout=sensor.lost_at_readout,
        read_out=sensor.read_out,
        links=tuple(
            LinkLedger(name, report.delivered, report.dropped, report.dropped_in_device)
            for name, report in reports.items()
        ),
        second=second,
    )
