"""Two cameras of dv-processing 2.x, which the library itself brings to one clock."""

from __future__ import annotations

import dv_processing as dv
from collecting import arguments
from stereo import LEFT, RIGHT, take_both


def main() -> None:
    options = arguments()
    cameras = dv.io.camera.openSync(LEFT), dv.io.camera.openSync(RIGHT)
    dv.io.camera.synchronizeAnyTwo(*cameras)
    assert all(camera.isSynchronized() for camera in cameras)
    assert [camera.isMaster() for camera in cameras] == [True, False]
    take_both(cameras, options)


if __name__ == "__main__":
    main()
