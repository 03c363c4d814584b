"""`--truth FILE`: a .csv for the camera's clock, an .h5 for the scene and the sensor; by the suffix."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from emulator.cli.output import LACKING, WRONG_USE, Failure, console
from emulator.cli.output_paths import check_output
from emulator.rig.loading import Rig
from emulator.run.kernels import TRUTH, Part
from emulator.run.truth.refusal import SUFFIXES, TruthRefused, check_truth

__all__ = ["Truth"]


class Truth:
    """The truth files of a run, checked; raises Failure.

    Attributes
    ----------
    clock : the file for the error of the camera's clock.
    """

    def __init__(self, rig: Rig, path: Path | None, every: int) -> None:
        is_scene = path is not None and path.suffix in SUFFIXES
        self.clock = None if is_scene else path
        self._file: Any = None
        if path is None:
            return
        if is_scene:
            self._file = _truth_file(rig, path, every)
        elif rig.camera.clock is None or not rig.links:
            raise Failure(
                "--truth: give an .h5 file for the truth of scene and sensor; any other file is for the error of the "
                "camera's clock: this rig needs a [camera.clock] table and a link that carries its times",
                WRONG_USE,
            )
        check_output("--truth", path)

    @property
    def parts(self) -> list[Part]:
        """What is compiled for it beside the rig's own parts."""
        return [] if self._file is None else [TRUTH]

    @property
    def trouble(self) -> str:
        """Why the file is not whole; "" where it is, or none was asked for."""
        return "" if self._file is None else self._file.trouble

    def begin(self) -> AbstractContextManager[Any]:
        """Return what finishes the file at its end, as `build_session` wants it; None in it where there is none."""
        return nullcontext() if self._file is None else self._file

    def tell(self) -> None:
        """Print what went wrong."""
        if self.trouble:
            console.print(f"--truth: {self.trouble}", markup=False)


def _truth_file(rig: Rig, path: Path, every: int) -> Any:
    try:
        check_truth(rig, path, every)
    except TruthRefused as error:
        raise Failure(f"--truth: {error}", WRONG_USE) from error
    except ImportError as error:
        raise Failure(f"--truth: {error}", LACKING) from error
    from emulator.run.truth.output import TruthFile

    return TruthFile(rig, path, every)
