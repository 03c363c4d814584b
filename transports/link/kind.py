"""Description of one kind of link: all data that a rig, a run and the command line need.

Each transport has a description in its own folder, and a package outside evstim provides one as an entry point of the
group "evstim.links". `emulator.rig.kinds` lists the built-in ones; docs/extend.md "A link" lists what else one needs.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Generic, Literal, Protocol, TypeVar

from msgspec import Meta

from transports.faults.kinds import FAULTS, Fault
from transports.faults.script import FaultPlan
from transports.link.edges import EdgeSink
from transports.needs import Need

EVENT_OCTETS = dict(jaer=8, caer=8, t64_x16_y16_on8=13, t32_x16_y15_on1=8, evt2=4, evt21=8, evt3=5, spif=4)
"""Octets of an event in streams without packets of an instrument, about; of EVT fewer in rows that are full of them."""

Port = Annotated[int, Meta(ge=0, le=65535)]
"""A port of UDP or TCP to listen on; 0: any free one."""


class LinkParameters:
    """Base of the [[links]] tables of a rig: frozen dataclasses with the name of their kind and their own name.

    A table overrides what depends on its parameters.
    """

    kind: ClassVar[str]
    name: str
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @classmethod
    def complete(cls, table: dict[str, Any]) -> dict[str, Any]:
        """Return a rig's table with derived values, before its types are checked."""
        return table

    def impossible_faults(self) -> Collection[str]:
        """Return the kinds of faults of its carrier that this link cannot have."""
        return ()

    def listens_on(self) -> tuple[str, int] | None:
        """Return the (host, port) that no other link may use; None if there is none, or any free one is suitable."""
        return None

    def needs(self) -> tuple[Need, ...]:
        """Return the requirements on the machine, beyond evstim and its base dependencies."""
        return ()

    def carries_hz(self, camera: CameraFacts) -> float:
        """Return the events a second that its line carries, about; infinity: it has no limit of its own."""
        return math.inf

    def sends_evt(self) -> bool:
        """Return true if it sends EVT3 or EVT2 words: a run compiles their kernels before it begins."""
        return False


class _Instrument(Protocol):
    def selection(self, size: tuple[int, int], /) -> object:
        """Return the region of a sensor of `size`; raises ValueError if it extends beyond."""

    def selected_share(self, size: tuple[int, int], /) -> float: ...


class InstrumentLink(LinkParameters):
    """Base of the tables of links that serve an instrument: `instrument` is its `InstrumentSettings`."""

    instrument: _Instrument


P = TypeVar("P", bound=LinkParameters)


@dataclass(frozen=True)
class CameraFacts:
    """Properties of the camera against which a link checks its parameters.

    Attributes
    ----------
    size : (width, height) of the rig's sensor, pixels.
    usb_size : size of its model's USB device; None if there is none.
    has_gige : True if it is a GigE Vision device.
    usb_models : function that returns the size of each camera model that has a USB device.
    gige_models : function that returns the camera models that have a GigE Vision device.
    streams : streams of the camera beside events, as `Facts.streams`.
    imu_unit : type of its inertial unit: 1 MPU-6050, 2 MPU-9250, 3 BMI160.
    speed : its USB speed: "high" or "super".
    """

    model: str
    size: tuple[int, int]
    usb_size: tuple[int, int] | None = None
    has_gige: bool = False
    usb_models: Callable[[], Mapping[str, tuple[int, int]]] = dict
    gige_models: Callable[[], tuple[str, ...]] = tuple
    streams: frozenset[str] = frozenset({"edges"})
    imu_unit: int = 2
    speed: str = "super"


_NO_CAMERA = CameraFacts("", (0, 0))


class Unsuitable(ValueError):
    """Error: a link's parameters do not fit the camera; `key`: path of the wrong key within the link's table."""

    def __init__(self, message: str, *key: str) -> None:
        super().__init__(message)
        self.key = key


@dataclass(frozen=True)
class Wiring:
    """Connections of a link's endpoint, beside its device.

    Attributes
    ----------
    faults : the rig's faults of this link.
    sink : receiver of the time of each SYNC on the link's bus; None if SYNCs trigger nothing.
    camera : the rig's camera.
    """

    faults: FaultPlan = field(default_factory=FaultPlan)
    sink: EdgeSink | None = None
    camera: CameraFacts = _NO_CAMERA


@dataclass(frozen=True)
class Listener:
    """Receiver of a link as a verb of `evstim listen`; `path` is that of its function, "module:name"."""

    verb: str
    help: str
    path: str


@dataclass(frozen=True)
class LinkKind(Generic[P]):
    """One kind of link.

    Attributes
    ----------
    parameters : type of its [[links]] table; its `kind` is the kind's name.
    serves : The device behind it: "usb", the USB device of the camera's model; "gige", a GigE Vision device;
        "instrument", the camera without USB; "plain", no electronics: events go out as the sensor sends them.
    endpoint : Import path, "module:name", imported when a link is set up: of the class of its `Endpoint`, which is
        called with the parameters, a Wiring, the device and `Deliveries`; or of a function that returns an
        `EndpointFactory` for the parameters and a Wiring.
    has_sync : True if its bus has a SYNC, which can trigger the camera.
    carrier : carrier of its data, which decides its faults, see `Fault.carriers`; "": it has none.
    listener : receiver of the link at the computer's side.
    check : function that raises Unsuitable for parameters that do not fit the camera.
    usb_model : With "usb": the camera model in whose words it carries a camera that has no USB device of its size, and
        that then does not wait after its start; None: it carries none of these.
    has_readings : with "plain": True if it accepts frames and samples of the inertial unit.
    """

    parameters: type[P]
    serves: Literal["usb", "gige", "instrument", "plain"]
    endpoint: str
    has_sync: bool = False
    carrier: str = ""
    listener: Listener | None = None
    check: Callable[[P, CameraFacts], None] = lambda parameters, camera: None
    usb_model: str | None = None
    has_readings: bool = False

    def __post_init__(self) -> None:
        needed = {"name"} | ({"instrument"} if self.serves == "instrument" else set())
        if not isinstance(getattr(self.parameters, "kind", None), str):
            raise ValueError("the parameters of a link need a class attribute `kind`")
        if missing := needed - {parameter.name for parameter in dataclasses.fields(self.parameters)}:
            raise ValueError(f"the parameters of a link that serves {self.serves!r} need {', '.join(sorted(missing))}")

    @property
    def name(self) -> str:
        """Name of the kind, the value of `kind` in rigs."""
        return self.parameters.kind


def possible_faults(kind: LinkKind[P], parameters: P) -> Mapping[str, type[Fault]]:
    """Return the faults that a link of these parameters can have, by kind."""
    impossible = parameters.impossible_faults()
    return {
        name: fault
        for name, fault in FAULTS.usable().items()
        if kind.carrier in fault.carriers and name not in impossible
    }


def check_region(parameters: InstrumentLink, camera: CameraFacts) -> None:
    """Raise Unsuitable if the instrument's region extends beyond the sensor."""
    try:
        parameters.instrument.selection(camera.size)
    except ValueError as error:
        raise Unsuitable(str(error), "instrument", "region") from error


def check_size(form: str, limit_px: tuple[int, int], camera: CameraFacts) -> None:
    """Raise Unsuitable if the sensor has more columns or rows than a format can number."""
    if camera.size[0] > limit_px[0] or camera.size[1] > limit_px[1]:
        limit, size = (f"{width} x {height}" for width, height in (limit_px, camera.size))
        raise Unsuitable(f"{form} numbers {limit} pixels, not {size}", "format")
