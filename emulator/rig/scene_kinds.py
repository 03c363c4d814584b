"""The registry of kinds of scenes: the built-in ones, and those of installed packages (group "evstim.scenes")."""

from __future__ import annotations

from emulator.scene.kind import SceneKind
from emulator.tables.registry import Registry

__all__ = ["SCENES"]

SCENES: Registry[SceneKind] = Registry(
    "evstim.scenes",
    SceneKind,
    {
        "checkerboard": "emulator.scene.checkerboard.table:CHECKERBOARD",
        "bodies": "emulator.scene.bodies.table:BODIES",
        "terrain": "emulator.scene.terrain.table:TERRAIN",
        "stars": "emulator.scene.stars.table:STARS",
        "video": "emulator.scene.video.video:VIDEO",
        "ros2": "emulator.scene.video.ros2_images:ROS2_IMAGES",
        "recording": "emulator.playback.recording:RECORDING",
    },
)
"""Kinds of scenes by the name that rigs write."""
