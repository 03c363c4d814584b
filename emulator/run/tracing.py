"""The trace of what goes over the cables of a run's links."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from transports.link.process import LinkSetup

__all__ = ["traced"]


def traced(setups: Sequence[LinkSetup[Any]], path: Path | None) -> tuple[list[LinkSetup[Any]], list[Path]]:
    """Return the links with a trace of those that have a USB cable, and the FILE of each trace.

    FILE is `path`, with the link's name behind it where there are several; without a path nothing is traced.
    """
    if path is None:
        return list(setups), []
    names = [setup.name for setup in setups if setup.endpoint.traced(path) is not None]
    paths = {name: path if len(names) == 1 else path.with_name(f"{path.name}-{name}") for name in names}
    return [_traced(setup, paths.get(setup.name)) for setup in setups], list(paths.values())


def _traced(setup: LinkSetup[Any], path: Path | None) -> LinkSetup[Any]:
    endpoint = None if path is None else setup.endpoint.traced(path)
    return setup if endpoint is None else dataclasses.replace(setup, endpoint=endpoint)
