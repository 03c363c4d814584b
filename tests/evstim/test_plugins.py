"""A package outside the checkout adds a kind of link and a kind of scene, and a run uses both."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]

MODULE = '''
"""A beacon: a link that writes how many events it was given into a file, and a scene that blinks."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from emulator.light import Scene
from emulator.scene.kind import SceneKind
from firmware_protocol.instrument.settings import InstrumentSettings
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.link.kind import LinkKind, LinkParameters, Listener, Unsuitable


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

    def build(self, device, deliveries):
        return BeaconEndpoint(self.path, device, deliveries)


class BeaconEndpoint(Endpoint):
    def __init__(self, path, device, deliveries):
        self._path, self._device, self._deliveries, self._events = path, device, deliveries, 0

    async def start(self):
        self._device.connected()

    def pump(self):
        while (message := self._device.next_message()) is not None:
            self._device.sent(message)
            self._deliveries.add(message.events, message.epoch_us, message.edges)
            self._events += len(message.events)

    async def close(self):
        self._device.disconnected()
        Path(self._path).write_text(str(self._events))

    @property
    def state(self):
        return f"{self._events} events"


def factory_of(link, wiring):
    return BeaconFactory(link.path)


def check(link, camera):
    if camera.size[0] > 400:
        raise Unsuitable("too large a camera for a beacon", "path")


BEACON = LinkKind(
    BeaconLink,
    serves="instrument",
    endpoint="beacon_package:factory_of",
    check=check,
    listener=Listener("beacon", "Read a beacon.", "beacon_package:listen"),
)


def listen() -> int:
    """Read a beacon."""
    return 0


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


BLINK = SceneKind(BlinkParameters, "beacon_package:Blink")
'''

RIG = """
title = "A blinking light, reported by a beacon."
[scene]
kind = "blink"
period_ms = 10.0
[run]
seconds = 0.05
pace = "free"
[[links]]
kind = "beacon"
path = "{path}"
"""


@pytest.fixture
def site(tmp_path):
    folder = tmp_path / "site"
    info = folder / "beacon_package-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "beacon_package.py").write_text(MODULE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: beacon-package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[evstim.links]\nbeacon = beacon_package:BEACON\n[evstim.scenes]\nblink = beacon_package:BLINK\n"
    )
    return folder


def evstim(site, *arguments):
    code = "from emulator.cli import main; main()"
    environment = {**os.environ, "PYTHONPATH": f"{site}{os.pathsep}{ROOT}"}
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=site, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


def rig_file(tmp_path, text=RIG):
    path = tmp_path / "beacon.toml"
    path.write_text(text.format(path=tmp_path / "count.txt"))
    return path


def test_a_run_with_a_scene_and_a_link_of_a_package(site, tmp_path):
    done = evstim(site, "run", rig_file(tmp_path), "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["balanced"] is True
    (delivered,) = [link["delivered"] for link in told["events"]["links"].values()]
    assert delivered > 0
    assert int((tmp_path / "count.txt").read_text()) == delivered


def test_schema_and_verbs_know_the_package(site):
    schema = json.loads(evstim(site, "schema").stdout)
    assert schema["$defs"]["BeaconLink"]["properties"]["kind"] == {"const": "beacon"}
    assert "period_ms" in schema["$defs"]["BlinkParameters"]["properties"]
    assert "Read a beacon." in evstim(site, "listen", "--help").stdout


def test_a_check_of_the_package_is_told_by_line(site, tmp_path):
    done = evstim(site, "check", rig_file(tmp_path, RIG + '[camera]\nmodel = "imx636"\n'))
    assert done.returncode == 2
    assert "line 11: links[0].path: too large a camera" in " ".join(done.stderr.split())


def test_a_broken_package_stops_only_rigs_that_name_it(site, tmp_path):
    (site / "beacon_package.py").write_text("raise RuntimeError('half installed')\n")
    done = evstim(site, "check", rig_file(tmp_path))
    assert done.returncode == 2
    told = " ".join(done.stderr.split())
    assert "of package beacon-package" in told
    assert "half installed" in told
    assert evstim(site, "check", "loopback").returncode == 0
    assert evstim(site, "schema").returncode == 0
    assert evstim(site, "listen", "--help").returncode == 0
