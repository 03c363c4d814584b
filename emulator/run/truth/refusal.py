"""Whether there can be truth of a run; asked before anything is opened."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from emulator.rig.loading import Rig
from emulator.rig.scene_kinds import SCENES
from transports.needs import install_command

__all__ = ["SUFFIXES", "TruthRefused", "check_truth"]

SUFFIXES = (".h5", ".hdf5")


class TruthRefused(ValueError):
    """There can be no truth of this run; the message says why."""


def check_truth(rig: Rig, path: Path, every: int = 1) -> None:
    """Raise TruthRefused where no truth of the rig can be written to `path`, ImportError where h5py is missing."""
    if path.suffix not in SUFFIXES:
        raise TruthRefused(f"{path} must end in {' or '.join(SUFFIXES)}")
    if every < 1:
        raise TruthRefused(f"every {every}th picture: it must be 1 or more")
    if SCENES[rig.scene.kind].events:
        raise TruthRefused(f"a {rig.scene.kind} plays events that exist already: nothing is known of what raised them")
    if find_spec("h5py") is None:
        raise ImportError(f"it needs h5py: {install_command('files')}")
