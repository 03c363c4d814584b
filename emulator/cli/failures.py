"""Errors of the packages as failures of a command, with their exit codes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from emulator.cli.output import LACKING, WRONG_USE, Failure
from emulator.light import MachineLacks, SceneError
from emulator.rig.loading import RigError
from emulator.run.link_process import LinkFailed
from emulator.tables.registry import PluginError

__all__ = ["failures"]


@contextmanager
def failures() -> Iterator[None]:
    """Turn the errors of the packages into Failure with its exit code."""
    try:
        yield
    except (MachineLacks, LinkFailed, PluginError) as error:
        raise Failure(str(error), LACKING) from error
    except (RigError, SceneError) as error:
        raise Failure(str(error), WRONG_USE) from error
