"""The record of topics of ROS 2."""

from __future__ import annotations

from typing import Any

from firmware_protocol.evt3.words import LIMIT_PX
from transports.link.endpoint import EndpointFactory
from transports.link.kind import CameraFacts, LinkKind, Unsuitable, Wiring
from transports.needs import Need, package
from transports.ros2.parameters import Ros2Topics

__all__ = ["ROS2"]

_MONO_LIMIT_PX = 1 << 15


def _endpoint(link: Ros2Topics, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.ros2.endpoint import Ros2Factory

    return Ros2Factory(link, wiring.camera.size)


def _check(link: Ros2Topics, camera: CameraFacts) -> None:
    limit = LIMIT_PX if link.encoding == "evt3" else _MONO_LIMIT_PX
    if max(camera.size) > limit:
        raise Unsuitable(f"{link.encoding} numbers {limit} columns and rows, not {camera.size[0]} x {camera.size[1]}",
                         "encoding")  # fmt: skip


def _has_evt(link: Ros2Topics) -> bool:
    return link.encoding == "evt3"


def _needs(_: Ros2Topics) -> tuple[Need, ...]:
    return (package("cyclonedds"),)


ROS2 = LinkKind(Ros2Topics, serves="plain", endpoint=_endpoint, check=_check, has_evt=_has_evt, needs=_needs)
