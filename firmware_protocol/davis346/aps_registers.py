"""What the registers of the APS module ask of frames: module 2, see `registers`; times in cycles of the ADC's clock."""

from __future__ import annotations

from firmware_protocol.davis346.registers import Layout, Module, RegisterFile
from firmware_protocol.frame_lines import FrameSettings

__all__ = ["aps_waits_on_stall", "frame_settings"]

_RUN, _WAIT, _GLOBAL_SHUTTER, _ROI, _EXPOSURE, _INTERVAL = 4, 5, 7, 8, 12, 13


def frame_settings(values: RegisterFile, size: tuple[int, int], layout: Layout, *, words: bool) -> FrameSettings:
    """Return what they ask now; `words`: whether the data path runs.

    The region of interest is cut to the array of `size` = (width, height); an empty one gives no frames.
    """
    aps = [values.read(Module.APS, k) for k in range(14)]
    first_column, first_row, last_column, last_row = aps[_ROI : _ROI + 4]
    last_column, last_row = min(last_column, size[0] - 1), min(last_row, size[1] - 1)
    empty = first_column > last_column or first_row > last_row
    kilohertz = max(values.read(Module.SYSTEM, 4), 1) * max(values.read(Module.SYSTEM, 6), 1)
    exposure_ns, interval_ns = (cycles * 1_000_000 // kilohertz for cycles in (aps[_EXPOSURE], aps[_INTERVAL]))
    run = words and bool(aps[_RUN]) and not empty
    return FrameSettings(
        run, bool(aps[_GLOBAL_SHUTTER]), not layout.turned, aps[_EXPOSURE], exposure_ns, interval_ns,
        first_column, first_row, last_column, last_row,
    )  # fmt: skip


def aps_waits_on_stall(values: RegisterFile) -> bool:
    """Return whether lines that find no room wait for it."""
    return bool(values.read(Module.APS, _WAIT))
