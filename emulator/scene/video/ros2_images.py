"""A topic of images of ROS 2 as a scene, without ROS: `sensor_msgs/msg/Image` by CycloneDDS.

Received images are read when a light frame is drawn, at most 16 messages each time. An image of another size than the
sensor's is resampled by area in linear light. An image that does not match its message's header is refused and counted,
and the run continues with the valid ones; it continues also when the writer has gone.

Images are joined in the logarithm of light. For a light frame of time t, with the images' times shifted by a delay

    between two images          each pixel follows a straight line in log light, as in a video
    after the newest one        the newest one stays, and the light frame is counted as late
    before the first one        the first one; even grey where there is none

The time of an image is that of its arrival, or continues from the last one's by the difference of their stamps: so
stamps may be Unix time or the time of another simulation. A stamp that goes back, or that differs from the arrival by
more than a second, starts again at the arrival, and is counted.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from emulator.light import MachineLacks, SceneError
from emulator.scene.kind import SceneKind
from emulator.scene.video.video import Around, Frames, JoinedFrames, linear_light, resampled
from emulator.trajectory.live import SceneClock
from firmware_protocol.bounds import check_bounds
from firmware_protocol.events import Float32s
from firmware_protocol.ros2 import IMAGE, CdrError, ImageError, levels_of, parse_image
from transports.needs import install_command, package
from transports.ros2.kind import DdsNetwork, check_topic

if TYPE_CHECKING:
    from transports.ros2.dds import DdsParticipant, Message, TopicReader


_KNOWN = 16
_LEAST_APART_NS = 1000
_MOST_ASTRAY_NS = 1_000_000_000

_USED = "images"
_REPEATED = "images at the time of the one before"  # refused
_CLOCK_JUMPS = "jumps of the images' clock"  # stamps that did not continue those before
_LATE = "pictures without a new image"  # light frames drawn with an old image because no newer one was received


_DEPTH = 16
_GREY = 0.5
_LOOK_S = 0.01


@dataclass(frozen=True)
class Ros2ImageParameters:
    """A topic of images of ROS 2, without ROS (`pip install '.[ros2]'`).

    Attributes
    ----------
    topic : topic of `sensor_msgs/msg/Image`: mono8, mono16, 32FC1, rgb8, bgr8, rgba8, bgra8.
    levels
        "srgb": decoded by the sRGB curve; "linear": proportional to light, as floats always are.
    light_at_white : light of white relative to the sensor's reference level.
    floor : light of black, as a share of white.
    stamps : time of an image: "arrival", or "header": distances in time are those of the headers' stamps.
    delay_ms
        Delay until an image is shown: more than the time between two images, so that light follows a straight
        line in log between them; with less, it jumps.
    wait_s : time that the start waits for the first image; 0: no wait, and the scene is grey until it comes.
    reliable : True: lost images are requested again. Then a writer that is not reliable (sensor data) is not received.
    domain : ROS_DOMAIN_ID.
    interfaces
        Names or addresses of network interfaces; empty: this machine only. Without authentication: any machine
        there can write to the topic.
    peers : machines that are contacted by unicast.
    multicast : True: machines on `interfaces` find each other by multicast, as ROS 2 does by default.
    """

    kind: ClassVar[str] = "ros2"
    topic: str = "/image_raw"
    levels: Literal["srgb", "linear"] = "srgb"
    light_at_white: Annotated[float, Meta(ge=1e-9, le=1e9)] = 1.0
    floor: Annotated[float, Meta(ge=1e-6, le=1)] = 1e-3
    stamps: Literal["arrival", "header"] = "arrival"
    delay_ms: Annotated[float, Meta(ge=0, le=10_000)] = 50.0
    wait_s: Annotated[float, Meta(ge=0, le=3600)] = 10.0
    reliable: bool = False
    domain: int = 0
    interfaces: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    multicast: bool = False

    def __post_init__(self) -> None:
        check_bounds(self)
        check_topic("topic", self.topic)
        _ = self.network

    @property
    def network(self) -> DdsNetwork:
        """Network settings of the topic."""
        return DdsNetwork(self.domain, self.interfaces, self.peers, self.multicast)


ROS2_IMAGES = SceneKind(
    Ros2ImageParameters,
    "emulator.scene.video.ros2_images:open_ros2_images",
    kernels=False,
    needs=lambda _: (package("cyclonedds"),),
)


class Ros2Images(JoinedFrames):
    """The images of `source` on a sensor of `size` = (width, height).

    `clock` is the wall's, ns; `participant`, of this process, is closed with the scene.
    """

    def __init__(
        self, parameters: Ros2ImageParameters, size: tuple[int, int], source: TopicReader,
        clock: Callable[[], int] = time.time_ns, participant: DdsParticipant | None = None,
    ) -> None:  # fmt: skip
        super().__init__(size)
        self._p = parameters
        self._source, self._participant = source, participant
        self._clock, self._scene_clock = clock, SceneClock()
        self._grey = np.full(size[::-1], self._log_light(np.float32(_GREY)), np.float32)
        self._delay_ns = round(parameters.delay_ms * 1e6)
        self._known: deque[tuple[int, Float32s]] = deque(maxlen=_KNOWN)  # with their times on the scene's clock
        self._ahead_ns: int | None = None  # of the stamps, beyond the scene's time
        self._counts = Counter({_USED: 0, _REPEATED: 0, _CLOCK_JUMPS: 0, _LATE: 0})

    @property
    def counts(self) -> Mapping[str, int]:
        """Images that were used and refused, and light frames without a new one."""
        return {name: count for name, count in self._counts.items() if count}

    def _around(self, t_ns: int) -> Around:
        """Read the received images, and return those around `t_ns`."""
        self._receive(t_ns)
        shown_ns, images = t_ns - self._delay_ns, self._known
        if not images or shown_ns <= images[0][0]:
            return Around.still(images[0][1] if images else self._grey)
        if shown_ns >= images[-1][0]:
            self._counts[_LATE] += shown_ns > images[-1][0]
            return Around.still(images[-1][1])
        after = next(k for k, (time_ns, _) in enumerate(images) if time_ns > shown_ns)
        (start_ns, before), (end_ns, end) = images[after - 1], images[after]
        share = np.float32((shown_ns - start_ns) / (end_ns - start_ns))
        return Around(before, end, share, (end_ns - start_ns) * 1e-9)

    def wait(self, seconds: float) -> bool:
        """Wait for the first image; False where none has come."""
        until = time.monotonic() + seconds
        self._receive(0)
        while not self._counts[_USED] and time.monotonic() < until:
            time.sleep(_LOOK_S)
            self._receive(0)
        return self._counts[_USED] > 0

    def close(self) -> None:
        """Leave the topic."""
        self._source.close()
        if self._participant is not None:
            self._participant.close()

    def _receive(self, t_ns: int) -> None:
        if self._scene_clock.draw(t_ns, self._clock()):
            # The newest image stays from there.
            self._ahead_ns = None
            if self._known:
                newest = self._known[-1][1]
                self._known.clear()
                self._known.append((t_ns - self._delay_ns, newest))
        for message in self._source.take():
            self._use(message)

    def _use(self, message: Message) -> None:
        try:
            image = parse_image(message.data)
            levels = levels_of(image)
        except (CdrError, ImageError) as error:
            self._counts[f"images refused: {error}"] += 1
            return
        is_float = levels.dtype.kind == "f"
        light = linear_light(levels, Frames(levels).full_scale, is_linear=is_float or self._p.levels == "linear")
        arrival_ns = self._scene_clock.scene_ns(message.written_ns)  # never after now
        t_ns = self._time_ns(image.header.stamp_ns, arrival_ns)
        if self._known and t_ns < self._known[-1][0] + _LEAST_APART_NS:
            self._counts[_REPEATED] += 1
            return
        self._known.append((t_ns, self._log_light(resampled(light, self.size))))
        self._counts[_USED] += 1

    def _time_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        if self._p.stamps == "arrival":
            return arrival_ns
        if self._ahead_ns is not None:
            t_ns = stamp_ns - self._ahead_ns
            if abs(t_ns - arrival_ns) <= _MOST_ASTRAY_NS and not (self._known and t_ns < self._known[-1][0]):
                return t_ns
            self._counts[_CLOCK_JUMPS] += 1
        self._ahead_ns = stamp_ns - arrival_ns
        return arrival_ns

    def _log_light(self, light: Float32s | np.float32) -> Float32s:
        return np.asarray(np.log((light + np.float32(self._p.floor)) * np.float32(self._p.light_at_white)), np.float32)


def open_ros2_images(parameters: Ros2ImageParameters, size: tuple[int, int]) -> Ros2Images:
    """Return the scene, with its first image if one comes in time; raises SceneError."""
    try:
        from transports.ros2.dds import DdsParticipant, TopicQos

        participant = DdsParticipant(parameters.network)
        topic = participant.reader(parameters.topic, IMAGE, TopicQos(parameters.reliable, _DEPTH))
    except ImportError as error:
        raise MachineLacks(f"a topic of ROS 2 needs cyclonedds ({error}): {install_command('ros2')}") from error
    except OSError as error:
        raise SceneError(str(error)) from error
    scene = Ros2Images(parameters, size, topic, participant=participant)
    if parameters.wait_s and not scene.wait(parameters.wait_s):
        refused, writers = dict(scene.counts), topic.writers
        scene.close()
        raise SceneError(_nothing_came(parameters, writers, refused))
    return scene


def _nothing_came(p: Ros2ImageParameters, writers: int, refused: dict[str, int]) -> str:
    """Return the reason why no image has come."""
    lack = f"no image came on {p.topic} in domain {p.domain} within {p.wait_s:g} s"
    if refused:
        return f"{lack}: {', '.join(f'{count} {name}' for name, count in refused.items())}"
    if writers:
        return f"{lack}, though a program writes to it"
    scope = "" if p.interfaces else "; only programs on this machine are received (interfaces)"
    return (
        f"{lack}: no program in reach writes sensor_msgs/msg/Image to it{scope}; "
        "see docs/streams.md for ROS's own settings"
    )
