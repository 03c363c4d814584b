"""One of each kind of thing that a package can add to evstim, as small as it gets; `tests/evstim/test_plugins.py`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from emulator.cli.output import console
from emulator.cli.verbs import Verb
from emulator.light import Scene
from emulator.optics.lens import Chip
from emulator.rig.kinds import CameraModel
from emulator.scene.kind import SceneKind
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import EVENT
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.recordings.part import Facts, Part
from transports.faults.kinds import ItemStage, LastingFault
from transports.faults.script import FaultPlan, Faulty, pass_through
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.link.kind import LinkKind, LinkParameters, Listener, Unsuitable
from transports.recording.format import Format
from transports.recording.part import RecordingError


@dataclass(frozen=True)
class BlinkParameters:
    """All pixels blink.

    Attributes
    ----------
    period_ms
        How long bright and dark last together.
    """

    kind: ClassVar[str] = "blink"
    period_ms: float = 20.0


class Blink(Scene):
    def __init__(self, parameters, size):
        self._period_ns, self._size = round(parameters.period_ms * 1e6), size

    @property
    def size(self):
        return self._size

    @property
    def motion_bound_px_s(self):
        return 0.0

    def light(self, t_ns, out):
        out.fill(1.0 if t_ns % self._period_ns * 2 < self._period_ns else 0.2)

    def close(self):
        pass


BLINK = SceneKind(BlinkParameters, "outsider:Blink")

DOT = CameraModel(
    "dot",
    SensorParameters(32, 24, threshold_on=0.25, threshold_off=0.25),
    Chip(15.0, fill_factor=0.25, quantum_efficiency=0.3),
)


class _Mute(ItemStage):
    def change(self, item):
        self.count(1, 1)
        return []


@dataclass(frozen=True)
class Muted(LastingFault):
    """The beacon shines, and nobody sees it."""

    kind: ClassVar[str] = "muted"
    carriers = ("a beacon",)
    effect: ClassVar[type] = _Mute


class BeaconFaults(Faulty):
    carrier = "a beacon"

    def advance(self, now_us):
        self._faults.advance(now_us)

    def passes(self, message):
        passed = pass_through(self._faults, message, 0)
        if not passed:
            self._faults.lose(len(message.events), len(message.edges))
        return bool(passed)


@dataclass(frozen=True)
class BeaconLink(LinkParameters):
    """A file that counts.

    Attributes
    ----------
    path
        Where it is.
    """

    kind: ClassVar[str] = "beacon"
    path: str = ""
    name: str = "beacon"
    instrument: InstrumentSettings = field(default_factory=InstrumentSettings)


@dataclass(frozen=True)
class BeaconFactory(EndpointFactory):
    path: str
    faults: FaultPlan

    def build(self, device, deliveries):
        return BeaconEndpoint(self, device, deliveries)


class BeaconEndpoint(Endpoint):
    def __init__(self, factory, device, deliveries):
        self._path, self._device, self._deliveries, self._events = factory.path, device, deliveries, 0
        self.faulty = BeaconFaults(factory.faults)

    async def start(self):
        self._device.connected()

    def pump(self):
        while (message := self._device.next_message()) is not None:
            self._device.sent(message)
            if self.faulty.passes(message):
                self._deliveries.add(message.events, message.epoch_us, message.edges)
                self._events += len(message.events)

    def advance_faults(self, stream_us):
        self.faulty.advance(stream_us)

    async def close(self):
        self.faulty.close()
        self._device.disconnected()
        Path(self._path).write_text(str(self._events))

    @property
    def state(self):
        return f"{self._events} events"


def factory_of(link, wiring):
    return BeaconFactory(link.path, wiring.faults)


def check(link, camera):
    if camera.size[0] > 400:
        raise Unsuitable("too large a camera for a beacon", "path")


BEACON = LinkKind(
    BeaconLink,
    serves="instrument",
    endpoint="outsider:factory_of",
    carrier="a beacon",
    check=check,
    listener=Listener("beacon", "Read a beacon.", "outsider:listen"),
)


def listen() -> int:
    """Read a beacon."""
    return 0


class LinesWriter:
    def __init__(self, path, facts):
        self._file = path.open("w")
        self._file.write("lines {} {}\n".format(*facts.size))

    def write(self, part):
        self._file.writelines(f"{t} {x} {y} {on:d}\n" for t, x, y, on in part.events.tolist())

    def close(self):
        self._file.close()


class LinesReader:
    def __init__(self, path, size):
        head, *self._lines = path.read_text().splitlines()
        _, width, height = head.split()
        self.facts = Facts((int(width), int(height)), "lines", streams=frozenset())

    def parts(self):
        try:
            yield Part(np.array([tuple(map(int, line.split())) for line in self._lines], EVENT))
        except ValueError as error:
            raise RecordingError("a line has other than four numbers") from error


LINES = Format(
    "lines", "lines of text", (".lines",), "outsider:LinesWriter", "outsider:LinesReader", b"lines ", readers="people"
)


def count(path: Path, /) -> int:
    """Count the events of a file of lines.

    Parameters
    ----------
    path
        The file.
    """
    console.print(sum(len(part.events) for part in LinesReader(path, None).parts()))
    return 0


COUNT = Verb("count", "outsider:count", "Count the events of a file of lines.")
