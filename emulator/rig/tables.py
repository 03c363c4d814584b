"""Tables of a rig that concern the whole run: [camera], [run], [trigger], [verdict] and [second_camera]."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from emulator.optics.lens import LensParameters
from emulator.sensor.parameters import FrameParameters, ImuParameters
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.tables.typed_table import Seed
from firmware_protocol.bounds import Share, check_bounds
from firmware_protocol.device.clock import ClockSettings
from firmware_protocol.events import EdgeKind
from firmware_protocol.prophesee.biases import BiasModel, BiasSlopes
from transports.link.edges import EdgeTiming, EdgeTrain


@dataclass(frozen=True)
class Camera:
    """The emulated camera.

    Attributes
    ----------
    model : name of a camera: its sensor's size, pixels and read-out, and its connector.
    serial : serial number that the host reads, up to 8 characters; of Prophesee's cameras on USB, hexadecimal digits.
    speed : USB speed; a DAVIS240C has high speed in any case.
    layout : orientation of a DAVIS346's chip: "turned" as in the hardware, where row words carry x. Drivers turn it
        back.
    fifo_bytes
        Size of the camera's output buffer; data without room in it is dropped and counted. 256 KiB, as in an FX3.
    start_delay_ms : least time from the host's start command to the first event (0 suits every driver but one).
    activity_filter : whether a DAVIS346 has its filters of background activity and refractory period. libcaer and
        neuromorphic_drivers switch the former on, and then do not receive events without another event near them.
    preset : preset of another unit of the same chip, such as "imx636_quiet" for an EVK4; without it, the model's own.
    sensor : sensor parameters that differ from the preset.
    clock : the camera's own clock; without it the camera shows stream time.
    imu : its inertial unit, of a DAVIS or a DVXplorer; without the table it has none.
    lens : for scenes in units of radiance; the others bring their own light.
    frames : the active pixels of a DAVIS: with this table the camera takes frames when its host requests them.
    bias_slopes : effect of a step of each bias of an IMX636 (model "evk4", "triton2", "imx636"), a Gen 3.1
        ("silkyevcam_vga") or a GenX320 ("genx320"); without it, the defaults of the sensor's page.
    """

    model: str = "davis346"
    serial: str = "00000346"
    speed: Literal["super", "high"] = "super"
    layout: Literal["upright", "turned"] = "upright"
    fifo_bytes: Annotated[int, Meta(ge=4096, le=1 << 30)] = 256 * 1024
    start_delay_ms: Annotated[float, Meta(ge=0, le=4000)] = 300.0
    activity_filter: bool = False
    preset: str = ""
    sensor: SensorParameters = field(default_factory=lambda: PRESETS["davis346"])
    clock: ClockSettings | None = None
    imu: ImuParameters | None = None
    lens: LensParameters = field(default_factory=LensParameters)
    frames: FrameParameters | None = None
    bias_slopes: BiasSlopes | None = None

    def __post_init__(self) -> None:
        check_bounds(self)
        if not 1 <= len(self.serial) <= 8 or not self.serial.isascii() or not self.serial.isprintable():
            raise ValueError(f"serial must have 1 to 8 printable ASCII characters, got {self.serial!r}")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor, pixels."""
        return self.sensor.width, self.sensor.height

    @property
    def bias_model(self) -> BiasModel:
        """Model of the effects of a Prophesee sensor's biases on this sensor."""
        slopes = self.bias_slopes or BiasSlopes()
        has_delay = self.sensor.jitter.latency_us > 0
        return BiasModel(slopes, "source_follower_hz" if self.sensor.source_follower_hz else "corner_max_hz", has_delay)


@dataclass(frozen=True)
class Run:
    """Time and method of the run.

    Attributes
    ----------
    seconds : stream time to run for; 0 means until Ctrl-C.
    step_us : time between two light frames.
    drawing_us : time between two exact drawings of bodies or terrain on known paths; light frames between them follow
        the motion of the surfaces. 0: two steps, or four where the image moves by more than a pixel in a step. Up to
        `step_us`: each light frame is drawn, as where poses come from outside.
    seed : seed of everything random.
    pace : "realtime": every event leaves at its own time; "free": as fast as the machine can, without loss; "lockstep":
        by `lockstep_us` for each SYNC of the trigger's bus.
    lockstep_us : stream time for each SYNC.
    lead_us : time by which steps are computed ahead of real time, at least one step: covers the machine's jitter.
    max_late_ms : in real time: greatest lateness of a step for a good verdict. 0: lateness is not judged,
        `max_late_share` included.
    max_late_share
        In real time: largest share of the steps that may be ready late for a good verdict; 0: none; 1: any.
    restart_links : whether a link whose process died is started again, with its record and file in
        NAME-restart1.SUFFIX; else the others go on without it.
    fifo_priority : above 0: links run under SCHED_FIFO at this priority, for steady delivery on a busy machine. Needs
        root, or a limit of 'rtprio'.
    method : interpolation of light between two frames: "hermite" (a cubic from value and derivative), "line" (straight
        in log light).
    painter : renderer of bodies and terrain: "cpu", the exact mean light of each pixel, the same on every machine;
        "gl", points in each pixel by OpenGL 4.3. The environment variable EVSTIM_RENDERER replaces this key.
    threads : threads of drawing, blur and the pixel step, without effect on events. 0: chosen by the work, at most 4.
    tolerance_us : tolerated timestamp error, 95th percentile: steps are as long as it allows, `step_us` the first one,
        and effects that change less are left out (`evstim plan`). 0: steps of `step_us`, nothing left out.
    tolerated_wrong_share : with `tolerance_us`: share of the events that may be wrong, missing or invented. 1: times
        alone limit steps.
    quality : rung from the most accurate, 0, to the fastest, 5, which stands for other keys: `drawing_us` of bodies and
        terrain is 1, 2, 4, 4, 6 or 8 steps, and from 3 on the grade of the sensor's noise is "offsets". `evstim plan`
        shows them, `evstim tune` what each rung costs here. -1: none.
    """

    seconds: Annotated[float, Meta(ge=0, le=3.2e7)] = 0.0
    step_us: Annotated[int, Meta(ge=1, le=1_000_000)] = 1000
    drawing_us: Annotated[int, Meta(ge=0, le=60_000_000)] = 0
    seed: Seed = 1
    pace: Literal["realtime", "free", "lockstep"] = "realtime"
    lockstep_us: Annotated[int, Meta(ge=0, le=3_600_000_000)] = 0
    lead_us: Annotated[int, Meta(ge=0, le=10_000_000)] = 10_000
    max_late_ms: Annotated[float, Meta(ge=0, le=3.6e6)] = 1000.0
    max_late_share: Share = 0.01
    restart_links: bool = False
    fifo_priority: Annotated[int, Meta(ge=0, le=99)] = 0
    method: Literal["hermite", "line"] = "hermite"
    painter: Literal["cpu", "gl"] = "cpu"
    threads: Annotated[int, Meta(ge=0, le=64)] = 0
    tolerance_us: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    tolerated_wrong_share: Share = 0.01
    quality: Annotated[int, Meta(ge=-1, le=5)] = -1

    def __post_init__(self) -> None:
        check_bounds(self)
        if (self.pace == "lockstep") != bool(self.lockstep_us):
            raise ValueError('lockstep_us and pace = "lockstep" go together: give both or neither')
        if self.tolerance_us != 0 and not 0.01 <= self.tolerance_us <= 1e6:
            raise ValueError(f"tolerance_us must be 0 (none) or 0.01 to 1e6, got {self.tolerance_us}")


Kind = Literal["pulse", "rising", "falling"]


@dataclass(frozen=True)
class TriggerEdges:
    """Edges at given times of the run.

    Attributes
    ----------
    at_ms : stream time of the first.
    kind : as `kind` of the trigger.
    every_ms : above 0, it is repeated with this period.
    count : number of edges in all; 0: without end. Without a period: once.
    """

    at_ms: Annotated[float, Meta(ge=0, le=1e10)]
    kind: Kind = "pulse"
    every_ms: float = 0.0
    count: int = 0

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.every_ms != 0 and not 0.01 <= self.every_ms <= 1e7:
            raise ValueError(f"every_ms must be 0 (once) or 0.01 to 1e7, got {self.every_ms}")
        if self.count < 0 or (self.count > 1 and not self.every_ms):
            raise ValueError(f"count must be 0 or more, and every_ms be given for more than one, got {self.count}")

    def train(self) -> EdgeTrain:
        """Return the edges as a link makes them."""
        count = (self.count or None) if self.every_ms else 1
        return EdgeTrain(EdgeKind[self.kind.upper()], round(self.at_ms * 1000), round(self.every_ms * 1000), count)


@dataclass(frozen=True)
class Trigger:
    """Source of edges at the camera's external input.

    Attributes
    ----------
    source : name of the CAN link whose SYNC triggers.
    period_ms : instead: an edge each period of stream time, the first after one period.
    edges : instead: edges at given times, without latency and jitter.
    kind : edges at the input; a pulse rises, and falls again after `pulse_us`.
    channel : number of the input; a DAVIS346 has one, 0.
    latency_us : from the bus to the input.
    jitter_us : standard deviation of the latency, normal and never below zero in all.
    pulse_us : length of a pulse.
    holdback_us : with a source: delay of events, so that an edge which is received late still comes in order; later
        ones are stamped at the earliest time possible, and counted.
    send_period_ms : above 0, the camera itself sends a mark on the bus each time its own clock has gone this far.
    """

    source: str = ""
    period_ms: float = 0.0
    edges: tuple[TriggerEdges, ...] = ()
    kind: Kind = "pulse"
    channel: Annotated[int, Meta(ge=0, le=255)] = 0
    latency_us: Annotated[float, Meta(ge=0, le=1e7)] = 0.0
    jitter_us: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    pulse_us: Annotated[int, Meta(ge=1, le=1_000_000)] = 100
    holdback_us: Annotated[int, Meta(ge=0, le=1_000_000)] = 2000
    send_period_ms: float = 0.0

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.source and self.period_ms:
            raise ValueError("period_ms makes edges without a bus; leave it out, or leave out source")
        if self.edges and (self.source or self.period_ms):
            raise ValueError("edges come at given times; leave them out, or leave out source and period_ms")
        if not (self.source or self.period_ms or self.edges or self.send_period_ms):
            raise ValueError("a trigger needs source (the name of a CAN link), period_ms, edges or send_period_ms")
        for name in ("period_ms", "send_period_ms"):
            value = getattr(self, name)
            if value != 0 and not 0.01 <= value <= 1e7:
                raise ValueError(f"{name} must be 0 (none) or 0.01 to 1e7, got {value}")

    def timing(self, seed: int) -> EdgeTiming:
        """Return the timing of an edge of this trigger."""
        return EdgeTiming(EdgeKind[self.kind.upper()], self.channel, self.latency_us, self.jitter_us, seed)


_Limit = Annotated[float, Meta(ge=0)]


@dataclass(frozen=True)
class Verdict:
    """Limits of a good run, beside a balanced ledger, sound links and whole files; 0 sets no limit.

    Attributes
    ----------
    max_drop : share of the events read out that a link may lose after its camera was started. Negative: any share.
    min_rate_hz, max_rate_hz : least and greatest mean event rate at the read-out, events per second, over the run.
    max_latency_us : greatest 99th percentile of the time from an event to its bytes, on any link.
    max_undersampled : share of the solved pixel-steps whose light may have changed unseen between two light frames.
    """

    max_drop: Annotated[float, Meta(le=1)] = -1.0
    min_rate_hz: _Limit = 0.0
    max_rate_hz: _Limit = 0.0
    max_latency_us: _Limit = 0.0
    max_undersampled: _Limit = 0.0

    def __post_init__(self) -> None:
        check_bounds(self)
        if 0 < self.max_rate_hz < self.min_rate_hz:
            raise ValueError(f"max_rate_hz {self.max_rate_hz} is below min_rate_hz {self.min_rate_hz}")


@dataclass(frozen=True)
class SecondCamera:
    """A second camera, mounted beside the first one on its clock.

    Attributes
    ----------
    links : names of the links that carry it; the others carry the first camera.
    model : name of a camera, with its own sensor's preset; without it, the first camera's model, sensor and parts.
    serial : its serial number, up to 8 characters.
    offset_m : its position along the first camera's axes: x right, y down, z along the boresight.
    q_first_from_second : its attitude relative to the first one: unit quaternion, scalar first.
    """

    links: tuple[str, ...]
    model: str = ""
    serial: str = "00000347"
    offset_m: tuple[float, float, float] = (0.1, 0.0, 0.0)
    q_first_from_second: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check_bounds(self)
        if not self.links:
            raise ValueError("links must name the links that carry this camera")
        if not 1 <= len(self.serial) <= 8 or not self.serial.isascii() or not self.serial.isprintable():
            raise ValueError(f"serial must have 1 to 8 printable ASCII characters, got {self.serial!r}")
        if not all(abs(part) <= 1e9 for part in self.offset_m):  # NaN compares false
            raise ValueError(f"offset_m must be three numbers of at most 1e9, got {self.offset_m}")
        if not abs(math.hypot(*self.q_first_from_second) - 1) < 1e-3:
            raise ValueError(f"q_first_from_second must be a unit quaternion, got {self.q_first_from_second}")
