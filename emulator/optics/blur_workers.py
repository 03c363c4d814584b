"""The threads that blur and scale large pictures: each does a share of the rows, to the same bits as one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from emulator.optics.passes import Part, blur_and_scale, strip_for
from emulator.threads import Crew, available_threads

__all__ = ["BlurWorkers"]

_WORTH_A_THREAD = 200_000
"""Pixels whose blur takes some times as long as to wake a thread."""

_Float32s = npt.NDArray[np.float32]


class BlurWorkers:
    """Blur by `taps`, then scale by `factor`, (height, width), of pictures of that size.

    Parameters
    ----------
    threads : how many work on a large part; 0: those available.
    """

    def __init__(self, taps: _Float32s, factor: _Float32s, threads: int = 0) -> None:
        self._taps, self._factor = taps, factor
        self._crew = Crew(threads or available_threads())
        self._strips = [strip_for(factor.shape[1], taps) for _ in range(self._crew.threads)]

    def __call__(self, pictures: Sequence[_Float32s], part: Part, outs: Sequence[_Float32s]) -> None:
        """Write `pictures`, blurred and scaled, to `outs`, in `part`."""
        first, last, left, right = part
        large = len(outs) * (last - first) * (right - left) >= _WORTH_A_THREAD
        count = self._crew.threads if large else 1
        rows = [first + (last - first) * k // count for k in range(count + 1)]

        def share(k: int, thread: int) -> None:
            for picture, out in zip(pictures, outs, strict=True):
                mine = rows[k], rows[k + 1], left, right
                blur_and_scale(picture, self._taps, self._factor, mine, self._strips[thread], out)

        self._crew.each(share, count)

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._crew.close()
