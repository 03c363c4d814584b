"""The CPU renderer: exact mean light of each pixel and its exact time derivative in one pass."""

from emulator.raster.layout import Owners, Screen, View
from emulator.raster.renderer import Renderer
from emulator.raster.topology import Facets, Topology, join, prepare

__all__ = ["Facets", "Owners", "Renderer", "Screen", "Topology", "View", "join", "prepare"]
