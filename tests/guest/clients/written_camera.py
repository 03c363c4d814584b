"""A camera of dv-processing, all of whose streams the library's own writer also puts into an AEDAT4 file."""

from __future__ import annotations

import argparse
from typing import Any

import dv_processing as dv


def written(camera: Any, options: argparse.Namespace) -> Any:
    """Return the camera as it is, or with --aedat4 one that writes all that is taken from it."""
    return WrittenCamera(camera, options.aedat4) if options.aedat4 else camera


class WrittenCamera:
    """What the clients take of the camera, in the packets of its driver; the file is complete when it is deleted."""

    def __init__(self, camera: Any, path: str) -> None:
        self._camera = camera
        self._writer = dv.io.MonoCameraWriter(path, camera)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)

    def getNextEventBatch(self):
        batch = self._camera.getNextEventBatch()
        if batch is not None:
            self._writer.writeEvents(batch)
        return batch

    def getNextFrame(self):
        frame = self._camera.getNextFrame()
        if frame is not None:
            self._writer.writeFrame(frame)
        return frame

    def getNextImuBatch(self):
        batch = self._camera.getNextImuBatch()
        if batch is not None:
            self._writer.writeImuPacket(dv.IMUPacket(batch))
        return batch

    def getNextTriggerBatch(self):
        batch = self._camera.getNextTriggerBatch()
        if batch is not None:
            self._writer.writeTriggerPacket(dv.TriggerPacket(batch))
        return batch
