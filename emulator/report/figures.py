"""Charts in files, drawn by matplotlib (the extra `report`), without a screen."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from transports.needs import install_command

__all__ = ["ChartsLacking", "check", "pyplot", "save"]


class ChartsLacking(Exception):
    """matplotlib is not installed; the message tells how to get it."""


def pyplot() -> Any:
    """Return matplotlib's figure maker; raise ChartsLacking."""
    try:
        importlib.import_module("matplotlib").use("agg")
        return importlib.import_module("matplotlib.pyplot")
    except ImportError as error:
        raise ChartsLacking(f"charts need matplotlib:  {install_command('report')}") from error


def check() -> None:
    """Raise ChartsLacking where matplotlib is missing: before minutes of work, not after."""
    pyplot()


def save(figure: Any, stem: Path) -> list[Path]:
    """Write a figure as SVG and PNG and close it; return both files, SVG first."""
    paths = [stem.with_suffix(".svg"), stem.with_suffix(".png")]
    for path in paths:
        figure.savefig(path, dpi=110, bbox_inches="tight")
    pyplot().close(figure)
    return paths
