"""The CPU renderer: exact mean light of each pixel and its exact time derivative in one pass."""

from emulator.raster.renderer import Owners, Renderer
from emulator.raster.topology import Patches, Topology, join, prepare, with_patches
from emulator.raster.view import Box, Screen, View

__all__ = ["Box", "Owners", "Patches", "Renderer", "Screen", "Topology", "View", "join", "prepare", "with_patches"]
