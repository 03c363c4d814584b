"""The scene that an external renderer draws: its images at their times, and the light between two of them.

A light frame of time t needs the images around t. Requested images stand on a grid of `period_ms` from time 0; those
that come next are requested in advance. A time before the present images, as the probe of a plan uses, starts again at
the image of the grid before it: the renderer then gets an earlier time. Pushed images only go forward.

Images are checked and read in memory of this process alone, which no renderer can write into later. Light of integers
is converted by a table.

The first image that is not finite, has negative light, or is not later than the one before ends the run, and so does
a renderer that ends, or gives no image within `timeout_s`: the events until then have their fates. An END without a
reason is the regular end of the run.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Pinhole
from emulator.light import Light, SceneEnded, SceneError
from emulator.scene.external.joining import Joined, Pair, TimedImage, compile_kernels, front_motion
from emulator.scene.external.table import ExternalParameters
from emulator.scene.kind import SizedScene
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.live import close_receivers, live_counts
from emulator.trajectory.pose import Timescale, Trajectory, TrajectoryError
from firmware_protocol.compiled import entry_of
from firmware_protocol.renderer import Camera, Hello, Levels, MessageError, Response
from transports.renderer import Drawn, RendererConnection, RendererEnded, RendererError, RendererServer

_LOG = logging.getLogger(__name__)
_SRGB_KNEE = 0.04045
_MOST = 1e9
_MOST_RATE = 3e38
_LEAST_NS = 1000  # between two images: the shortest period of requested ones
_STOP_S = 1.0  # for the images of the present light frame, when a run is stopped
_MOST_A_FRAME = 4096  # images: a signal ends the run between two light frames

_entry = entry_of(__name__, _nrt=False)


@_entry
def _first_invalid(values: npt.NDArray[np.float32], low: float, high: float) -> int:
    """Return the index of the first value outside low to high, or NaN; -1 without."""
    for k in range(values.size):
        if not low <= values[k] <= high:
            return k
    return -1


_BOUNDS = {
    "light": (0.0, _MOST),
    "motion": (-_MOST, _MOST),
    "depth": (0.0, math.inf),
    "rate": (-_MOST_RATE, _MOST_RATE),
}


def _light_table(hello: Hello) -> npt.NDArray[np.float32] | None:
    """Return the light of each integer level, white 1; None for floats."""
    if hello.levels is Levels.FLOAT32:
        return None
    share = np.arange(1 << 8 * hello.levels.octets) / hello.white
    if hello.response is Response.SRGB:
        share = np.where(share <= _SRGB_KNEE, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return share.astype(np.float32)


class External(SizedScene):
    """The images of a renderer through `pinhole`, in units of radiance, by the order of their times.

    `connection` has `p.slots` slots. `path` is the camera's, None where the renderer moves it. `threads` is the number
    of threads that draw, 0: by the machine.
    """

    motion_bound_px_s = math.inf  # of the newest image; infinite where the renderer gives none

    def __init__(
        self,
        connection: RendererConnection,
        p: ExternalParameters,
        pinhole: Pinhole,
        path: Trajectory | None = None,
        threads: int = 0,
    ) -> None:
        super().__init__(pinhole.size)
        self._connection, self._p = connection, p
        self._path = path
        self.renderer = connection.hello.name or None
        self._time = Timescale(p.time_scale)
        if path is not None:  # which an inertial unit follows too
            self.camera_path, self.path_time = path, self._time
        self._pushed = p.images == "pushed"
        self._table = _light_table(connection.hello)
        self._images: deque[TimedImage] = deque(maxlen=2)  # those around the last light frame
        self._next_ns = 0
        self._zero_ns = None if self._pushed else 0  # the renderer's time at stream time 0
        self._taken = 0
        self._joined = Joined(pinhole.size, p.white_w_m2_sr, threads)

    @property
    def counts(self) -> Mapping[str, int]:
        """Images received, and poses where the path of the camera is live."""
        return {"images": self._taken, **live_counts(self._path)}

    def stop(self) -> None:
        """Limit the wait for images of the present light frame."""
        self._connection.limit_wait(_STOP_S)

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light at `t_ns` and its time derivative; raises SceneError."""
        self._joined.write(self.around(t_ns), t_ns, light, rate)

    def around(self, t_ns: int) -> Pair:
        """Return the images around `t_ns`, or a single one twice, and receive the missing ones; raises SceneError."""
        try:
            self._go_to(t_ns)
        except RendererEnded as error:
            raise SceneEnded(str(error)) from error
        except (RendererError, MessageError) as error:
            self._end(str(error))
            raise SceneError(f"renderer {self._connection.hello.name!r}: {error}") from error
        return self._images[0], self._images[-1]

    def close(self) -> None:
        """End the connection and the threads, and close the port of a live path."""
        self._end()
        self._joined.close()
        close_receivers(self._path)

    def _end(self, reason: str = "") -> None:
        self._images.clear()
        self._connection.close(reason)

    def _go_to(self, t_ns: int) -> None:
        if self._images and t_ns < self._images[0].t_ns:
            self._restart(t_ns)
        if not self._images and not self._pushed:
            self._next_ns = t_ns // self._p.period_ns * self._p.period_ns
        before = self._taken
        while not self._images or self._images[-1].t_ns < t_ns:
            if self._taken - before == _MOST_A_FRAME:
                raise RendererError(f"more than {_MOST_A_FRAME} images came for one light frame: give fewer")
            self._receive()
        self._request(self._p.ahead)

    def _restart(self, t_ns: int) -> None:
        """Leave all images, to begin again at `t_ns`."""
        if self._pushed:
            if self._taken == len(self._images):  # none came before: the first image stands before its time
                return
            raise RendererError(
                f"time {t_ns} ns was needed again, which pushed images cannot give: set no tolerance_us"
            )
        while self._connection.requested:
            self._connection.receive(self._p.timeout_s)
        self._images.clear()

    def _receive(self) -> None:
        """Receive the next image."""
        self._request(self._p.slots)
        image = self._connection.receive(self._p.timeout_s)
        self._images.append(self._checked(image))
        self._taken += 1
        bound = image.head.motion_bound_px_s
        self.motion_bound_px_s = math.inf if math.isnan(bound) else bound

    def _request(self, count: int) -> None:
        """Have `count` images requested."""
        while self._connection.requested < count:
            if self._pushed:
                self._connection.request()
                continue
            self._connection.request(self._next_ns, self._pose(self._next_ns))
            self._next_ns += self._p.period_ns

    def _pose(self, t_ns: int) -> tuple[float, ...] | None:
        if self._path is None:
            return None
        pose = self._path.pose(self._time.scene_ns(t_ns))
        return (*pose.position_m.tolist(), *pose.q_world_from_body.tolist())

    def _checked(self, image: Drawn) -> TimedImage:
        """Return an image with linear light and its stream time; raises RendererError."""
        planes = dict(image.planes)
        if self._table is not None:
            planes["light"] = self._table[planes["light"]]
        for name, plane in planes.items():
            if (k := _first_invalid(plane.reshape(-1), *_BOUNDS[name])) >= 0:
                row, column = divmod(k // (2 if name == "motion" else 1), plane.shape[1])
                raise RendererError(
                    f"image {image.head.number}: {name} is {plane.reshape(-1)[k]:g} in row {row}, column {column}: it "
                    f"must be {_BOUNDS[name][0]:g} to {_BOUNDS[name][1]:g}"
                )
        if self._zero_ns is None:
            self._zero_ns = image.head.t_ns - round(self._p.delay_ms * 1e6)
        t_ns = image.head.t_ns - self._zero_ns
        since_ns = t_ns - self._images[-1].t_ns if self._images else _LEAST_NS
        if since_ns <= 0:
            raise RendererError(
                f"image {image.head.number} is of {image.head.t_ns} ns, not later than the one before: times must go on"
            )
        if since_ns < _LEAST_NS:
            raise RendererError(
                f"image {image.head.number} is {since_ns} ns after the one before, at least {_LEAST_NS} are expected: "
                "times are in nanoseconds; does the renderer give milliseconds or seconds?"
            )
        if "motion" in planes:
            planes["motion"] = front_motion(planes["motion"], planes.get("depth"))
        return TimedImage(t_ns, **planes)


def open_external(p: ExternalParameters, pinhole: Pinhole, threads: int = 0) -> External:
    """Return the scene, once its renderer has connected; raises SceneError."""
    compile_kernels()
    try:
        path = None if p.camera is None else build_trajectory(p.camera)
    except (TrajectoryError, OSError) as error:
        raise SceneError(f"scene.camera: {error}") from error
    try:
        return External(_connected(p, pinhole), p, pinhole, path, threads)
    except BaseException:
        close_receivers(path)
        raise


def _connected(p: ExternalParameters, pinhole: Pinhole) -> RendererConnection:
    period_ns = 0 if p.images == "pushed" else p.period_ns
    camera = Camera(pinhole.size, pinhole.focal_px, period_ns, p.slots, 0, has_pose=p.camera is not None)
    try:
        server = RendererServer(p.host, p.port, p.allow)
        _LOG.info("waiting for a renderer on %s port %d, up to %g s", p.host, p.port, p.wait_s)
        connection = server.accept(camera, p.wait_s)
    except OSError as error:
        raise SceneError(f"scene: {p.host} port {p.port}: {error.strerror or error}") from error
    if connection is None:
        refused = f"; refused: {'; '.join(server.refusals)}" if server.refusals else ""
        raise SceneError(
            f"no renderer connected to {p.host} port {p.port} within {p.wait_s:g} s (scene.wait_s){refused}; start one "
            "that uses evstim.renderer, or see docs/renderers.md"
        )
    return connection
