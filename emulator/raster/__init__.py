"""The CPU renderer: exact mean light of each pixel and its exact time derivative in one pass."""

from emulator.raster.layout import Box, Owners, Screen, View
from emulator.raster.renderer import Renderer
from emulator.raster.topology import Patches, Topology, join, prepare, with_patches

__all__ = ["Box", "Owners", "Patches", "Renderer", "Screen", "Topology", "View", "join", "prepare", "with_patches"]
