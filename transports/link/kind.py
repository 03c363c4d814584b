"""The record of one kind of link: all that a rig, a run and the command line need to know of it.

Each transport has a record in its own folder, and a package outside evstim gives one as an entry point of the group
"evstim.links". Nothing else names kinds of links.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar

from firmware_protocol.instrument.settings import InstrumentSettings
from transports.faults.kinds import Fault
from transports.faults.script import FaultPlan
from transports.link.edges import EdgeSink
from transports.link.endpoint import EndpointFactory
from transports.needs import Need

__all__ = [
    "CameraFacts",
    "InstrumentLink",
    "LinkKind",
    "LinkParameters",
    "Listener",
    "Unsuitable",
    "Wiring",
    "check_region",
]


class LinkParameters(Protocol):
    """A [[links]] table of a rig: a frozen dataclass with the name of its kind and its own name."""

    kind: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def name(self) -> str:
        """What this rig calls the link."""
        ...


class InstrumentLink(LinkParameters, Protocol):
    """A [[links]] table of a link that serves an instrument."""

    @property
    def instrument(self) -> InstrumentSettings:
        """What the camera sends, and how much of it."""
        ...


P = TypeVar("P", bound=LinkParameters)


@dataclass(frozen=True)
class CameraFacts:
    """What a link can check its parameters against.

    Attributes
    ----------
    size
        (width, height) of the rig's sensor, pixels.
    usb_models
        Size of each camera model that has a USB device.
    gige_models
        Camera models that have a GigE Vision device.
    streams
        What the camera has beside events, as `Facts.streams`.
    imu_unit
        Type of its inertial unit: 1 MPU-6050, 2 MPU-9250.
    """

    model: str
    size: tuple[int, int]
    usb_models: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    gige_models: tuple[str, ...] = ()
    streams: frozenset[str] = frozenset({"edges"})
    imu_unit: int = 2


_NO_CAMERA = CameraFacts("", (0, 0))


class Unsuitable(ValueError):
    """A link's parameters do not go with the camera.

    Attributes
    ----------
    key
        Leads to the key to blame, within the link's table.
    """

    def __init__(self, message: str, *key: str) -> None:
        super().__init__(message)
        self.key = key


@dataclass(frozen=True)
class Wiring:
    """What a link's endpoint is connected to, beside its device.

    Attributes
    ----------
    faults
        The rig's faults of this link.
    sink
        Takes the time of each SYNC on the link's bus; None where these trigger nothing.
    camera
        The rig's camera.
    """

    faults: FaultPlan = field(default_factory=FaultPlan)
    sink: EdgeSink | None = None
    camera: CameraFacts = _NO_CAMERA


@dataclass(frozen=True)
class Listener:
    """The computer's side of a link as a verb of `evstim listen`; `path` is that of its function, "module:name"."""

    verb: str
    help: str
    path: str


def _unchanged(table: dict[str, Any]) -> dict[str, Any]:
    return table


def _suits(parameters: LinkParameters, camera: CameraFacts) -> None:
    return


def _nowhere(parameters: LinkParameters) -> tuple[str, int] | None:
    return None


def _nothing(parameters: LinkParameters) -> tuple[Need, ...]:
    return ()


def _never(parameters: LinkParameters) -> bool:
    return False


@dataclass(frozen=True)
class LinkKind(Generic[P]):
    """One kind of link.

    Attributes
    ----------
    parameters
        Type of its [[links]] table; its `kind` is the kind's name.
    serves
        The device behind it: "usb", the USB device of the camera's model; "gige", a GigE Vision device; "instrument",
        the camera without USB; "plain", no electronics: events go out as the sensor sends them.
    endpoint
        Makes the endpoint's factory, which is passed to the link's process by pickling. Import what is slow to import
        inside this function.
    has_sync
        Whether its bus has a SYNC, which can trigger the camera.
    faults
        Types of all faults that it can have, by kind.
    faults_of
        Those that a link of these parameters can have; None: all.
    listener
        What reads it at the computer's side.
    complete
        Completes a rig's table before its types are checked.
    check
        Raises Unsuitable for parameters that do not go with the camera.
    listens_on
        (host, port) that no other link may have; None where there is none, or any free port will do.
    usb_model
        With "usb": the camera model that it carries whatever the rig's is; None: the rig's.
    start_delay
        With "usb": whether the camera waits after its host's start command, as `camera.start_delay_ms` says.
    has_evt
        Whether a link of these parameters sends EVT3 or EVT2 words: a run compiles their kernels before it begins.
    needs
        What a link of these parameters needs of the machine, beyond evstim and its base dependencies.
    has_readings
        With "plain": whether it takes frames and samples of the inertial unit.
    """

    parameters: type[P]
    serves: Literal["usb", "gige", "instrument", "plain"]
    endpoint: Callable[[P, Wiring], EndpointFactory[Any]]
    has_sync: bool = False
    faults: Mapping[str, type[Fault]] = field(default_factory=dict)
    faults_of: Callable[[P], Mapping[str, type[Fault]]] | None = None
    listener: Listener | None = None
    complete: Callable[[dict[str, Any]], dict[str, Any]] = _unchanged
    check: Callable[[P, CameraFacts], None] = _suits
    listens_on: Callable[[P], tuple[str, int] | None] = _nowhere
    usb_model: str | None = None
    start_delay: bool = True
    has_evt: Callable[[P], bool] = _never
    needs: Callable[[P], tuple[Need, ...]] = _nothing
    has_readings: bool = False

    def __post_init__(self) -> None:
        needed = {"name"} | ({"instrument"} if self.serves == "instrument" else set())
        if not isinstance(getattr(self.parameters, "kind", None), str):
            raise ValueError("the parameters of a link need a class attribute `kind`")
        if missing := needed - {one.name for one in dataclasses.fields(self.parameters)}:
            raise ValueError(f"the parameters of a link that serves {self.serves!r} need {', '.join(sorted(missing))}")

    @property
    def name(self) -> str:
        """What rigs write as `kind`."""
        return self.parameters.kind

    def possible_faults(self, parameters: P) -> Mapping[str, type[Fault]]:
        """Return the faults that a link of these parameters can have, by kind."""
        return self.faults if self.faults_of is None else self.faults_of(parameters)


def check_region(parameters: InstrumentLink, camera: CameraFacts) -> None:
    """Raise Unsuitable when the instrument's region reaches beyond the sensor."""
    try:
        parameters.instrument.selection(camera.size)
    except ValueError as error:
        raise Unsuitable(str(error), "instrument", "region") from error
