"""Fly one landing: start the camera, the flight computer and the spacecraft; report the result.

    python fly.py [--height 300] [--seed 1] [--terrain 8] [--rig landing.toml] [--out DIR] [--real-time]

By default the vehicle flies with its own sensors and the camera's events (`--navigation events`; also blind, altimeter,
both, or given: the exact attitude from the simulation, as in real time). The seed draws the start (speeds, place), the
errors of navigation, sensors, mass, gravity and engine, the camera's noise. In DIR: truth.csv (the vehicle),
computer.jsonl (the computer's turns), summary.json (the camera's run), verdict.json, page.html; in real time
latency.json too. `--guidance my.py:Law` flies your law: docs/landing.md. With --attach CAN_PORT POSE_PORT SERIAL the
camera runs already: so `evstim campaign` uses it. `--fault crash@12` and others: see links.py; `--table faults.toml`
adds tables to the rig, such as [[faults]].

Exit codes: 0 landed within the bounds (given: below 1 m/s); 1 not; 2 wrong use or wrong rig; 3 something did not start.
"""

from __future__ import annotations

import argparse
import json
import logging
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import can
import numpy as np
from guidance import Law
from links import Connection, Fault, Faults
from pilot import LAW_FAILED, NAVIGATIONS, GivenLaw, LawFailed, PilotSettings
from real_time import STEP_S, RealTimeSpacecraft, latencies
from report import judgement, reasons, verdict, write_page
from sensors import SensorErrors, Sensors
from spacecraft import USUAL, Limits, Mission, SensingSpacecraft, Spacecraft, TouchDown, fly_without_camera
from vehicle import GRAVITY_M_S2, Height, Lander, State

from emulator.report.page import ChartsLacking
from emulator.rig.loading import load_rig
from emulator.scene.terrain.table import TerrainParameters
from emulator.scene.terrain.world import build_ground

Ended = Callable[[], str]
"""Returns a text when a process has ended; "" while it runs."""


_LACKING = 3  # exit code: the machine lacks something
_HERE = Path(__file__).parent
_READY_S = 600.0
_END_S = 10.0
_JOINED_S = 0.5  # the served bus sends no frames to a new client for a quarter of a second


@dataclass(frozen=True)
class Ends:
    """Addresses of the links: the bus's TCP port, the UDP port of poses, the serial line."""

    can_port: int
    pose_port: int
    serial: str

    @classmethod
    def free(cls, out: Path) -> Ends:
        """Return free ports, and a serial line in a folder."""
        with socket.create_server(("127.0.0.1", 0)) as bus, socket.socket(type=socket.SOCK_DGRAM) as poses:
            poses.bind(("127.0.0.1", 0))
            return cls(bus.getsockname()[1], poses.getsockname()[1], str(out / "serial"))

    def rig(self, text: str) -> str:
        """Return the text of a rig like landing.toml with these in it."""
        text = text.replace("29536", str(self.can_port)).replace("10364", str(self.pose_port))
        return text.replace("/tmp/evstim-landing", self.serial)


class NotStarted(RuntimeError):
    """A process did not start; `code` is the exit code by cause."""

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code


@contextmanager
def camera(rig: Path, seed: int, out: Path, record: Path | None = None) -> Iterator[Ended]:
    """Run evstim until the block ends; `record` takes the events.

    Gives a function that reports its end; raises NotStarted.
    """
    ready = out / "ready"
    ready.unlink(missing_ok=True)
    command = [sys.executable, "-m", "evstim", "run", str(rig), "--json", "--seconds", "0"]
    command += ["--seed", str(seed), "--ready-file", str(ready)]
    command += ["--record", str(record)] if record else []
    with (out / "summary.json").open("w") as summary, subprocess.Popen(command, stdout=summary) as run:
        try:
            end_s = time.monotonic() + _READY_S
            while not ready.exists():
                if run.poll() is not None or time.monotonic() > end_s:
                    raise NotStarted("evstim has not started, see above", run.poll() or _LACKING)
                time.sleep(0.05)
            yield _ended(run, "evstim")
        finally:
            run.terminate()


@contextmanager
def bus_of(ends: Ends) -> Iterator[can.BusABC]:
    """Give the bus."""
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)  # it warns of frames that TCP cut in two
    with can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=ends.can_port) as bus:
        time.sleep(_JOINED_S)
        yield bus


@contextmanager
def computer(ends: Ends, known: Sequence[str], seed: int, out: Path, more: Sequence[str] = ()) -> Iterator[Ended]:
    """Run the flight computer until the block ends; `known` are the arguments with the state from navigation.

    Gives a function that reports its end; raises NotStarted.
    """
    command = [sys.executable, str(_HERE / "flight_computer.py"), "--seed", str(seed), *more]
    command += ["--serial", ends.serial, "--can-port", str(ends.can_port), "--log", str(out / "computer.jsonl")]
    command += known
    failed = out / LAW_FAILED
    failed.unlink(missing_ok=True)
    (out / "last_events.npz").unlink(missing_ok=True)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            if process.stdout is None or process.stdout.readline().strip() != "ready":
                raise NotStarted("the flight computer has not started, see above", _LACKING)
            ended = _ended(process, "the flight computer")
            yield lambda: failed.read_text() if ended() and failed.exists() else ended()
        finally:
            process.terminate()
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()  # a law of the user's may hold the interpreter


def _ended(process: subprocess.Popen[str] | subprocess.Popen[bytes], name: str) -> Ended:
    """Return a function that gives a text when a process has ended."""

    def ended() -> str:
        code = process.poll()
        return "" if code is None else f"{name} has ended with {f'code {code}' if code >= 0 else f'signal {-code}'}"

    return ended


_COLUMNS = "t_s,x_m,y_m,z_m,ground_m,vx_m_s,vy_m_s,vz_m_s,thrust_n,mass_kg,qw,qx,qy,qz"


@dataclass(frozen=True)
class Start:
    """Start of a landing: the true state, and the state from navigation."""

    state: State
    lander: Lander
    known_height_m: float
    known_velocity_m_s: tuple[float, float, float]

    @classmethod
    def drawn(cls, height_m: float, seed: int) -> Start:
        """Return the start of a seed."""
        draw = np.random.default_rng(seed)
        down = Law().wanted_1_s(height_m) * height_m * draw.uniform(0.9, 1.1)
        velocity = np.array([*draw.normal(0, 0.0004 * height_m, 2), -down])
        mass_kg = draw.uniform(900, 1100)
        lander = Lander(thrust_scale=draw.uniform(0.97, 1.03))
        place_m = np.array([*draw.uniform(-5, 5, 2), height_m])  # heights are above the ground at the origin
        state = State(place_m, velocity, mass_kg=mass_kg, thrust_n=mass_kg * GRAVITY_M_S2)
        known = velocity * draw.uniform(0.95, 1.05)
        return cls(state, lander, height_m * draw.uniform(0.9, 1.1), tuple(known.tolist()))

    @property
    def known(self) -> list[str]:
        """Arguments of the flight computer."""
        return ["--height", str(self.known_height_m), "--velocity", *map(str, self.known_velocity_m_s)]


@dataclass(frozen=True)
class Flight:
    """Settings of a flight beside its start: addresses of the links, seed, files, faults, pace."""

    ends: Ends
    seed: int
    out: Path
    faults: Faults
    real_time: bool = False
    limits: Limits = USUAL
    navigation: str = ""
    delay_s: float = PilotSettings.delay_s
    guidance: str = ""

    @property
    def of_computer(self) -> list[str]:
        """Arguments of the flight computer."""
        real_time = ["--real-time", "--attitude-s", str(STEP_S)] if self.real_time else []
        law = ["--guidance", self.guidance] if self.guidance else []
        return [*self.faults.of_computer, *real_time, *law, "--delay-s", str(self.delay_s)]


def fly(height_m: float, flight: Flight, camera_ended: Ended = lambda: "") -> tuple[TouchDown, Height]:
    """Fly a landing whose camera runs already; return its end and the ground. Its files are in `flight.out`."""
    out, ends = flight.out, flight.ends
    ground = ground_of(out / "landing.toml")
    start = Start.drawn(height_m, flight.seed)
    mission = Mission.drawn(height_m, flight.seed)
    known = ["--navigation", flight.navigation, "--known", json.dumps(asdict(mission.known))]
    with ExitStack() as stack:
        bus = stack.enter_context(bus_of(ends))
        known = known if flight.navigation else start.known
        ended = stack.enter_context(computer(ends, known, flight.seed, out, flight.of_computer))
        record = stack.enter_context(_recorded(out / "truth.csv", ground))

        def trouble() -> str:
            return camera_ended() or ended()

        connection = Connection(bus, ("127.0.0.1", ends.pose_port), trouble, flight.faults)
        if flight.navigation:
            sensors = Sensors(SensorErrors(), mission.lander, flight.seed, ground)
            vehicle = SensingSpacecraft(mission, connection, sensors, flight.delay_s, flight.limits)
            return vehicle.land(ground, record), ground
        if not flight.real_time:
            return Spacecraft(start.lander, start.state, connection, flight.limits).land(ground, record), ground
        spacecraft = RealTimeSpacecraft(start.lander, start.state, connection, flight.limits)
        end = spacecraft.land(ground, record)
        (out / "spacecraft.json").write_text(json.dumps(spacecraft.times.as_json()))
        return end, ground


@contextmanager
def _recorded(file: Path, ground: Height) -> Iterator[Callable[[float, State], None]]:
    """Give a function that writes times and states to a file, and prints them."""
    with file.open("w") as truth:
        truth.write(_COLUMNS + "\n")

        def record(t_s: float, state: State) -> None:
            x, y, z = state.position_m.tolist()
            figures = (t_s, x, y, z, ground(x, y), *state.velocity_m_s, state.thrust_n, state.mass_kg)
            figures += tuple(state.attitude)
            print(",".join(f"{one:.6g}" for one in figures), file=truth, flush=True)
            print(f"\r{t_s:6.1f} s  {z:8.1f} m  {state.velocity_m_s[2]:7.2f} m/s", end="")

        yield record


def ground_of(rig: Path) -> Height:
    """Return the height of a rig's ground under a place; off its map that of the middle."""
    scene = load_rig(str(rig)).scene
    assert isinstance(scene, TerrainParameters), "landing.toml is a terrain"
    ground = build_ground(scene)
    return lambda x_m, y_m: ground.height_m(x_m, y_m) or 0.0


def main() -> int:
    """Fly once."""
    arguments = _arguments()
    navigation = arguments.navigation or ("given" if arguments.real_time else "events")
    if wrong := _wrong_use(arguments, navigation):
        print(f"fly.py: {wrong}", file=sys.stderr)
        return 2
    out = (arguments.out or Path(tempfile.mkdtemp(prefix="landing-"))).resolve()
    out.mkdir(parents=True, exist_ok=True)
    ends = Ends.free(out)
    if arguments.attach:
        can_port, pose_port, serial = arguments.attach
        ends = Ends(int(can_port), int(pose_port), serial)
    rig = out / "landing.toml"
    rig.write_text(_rig_text(arguments, ends))
    faults = Faults(arguments.fault, arguments.seed)
    limits = Limits(arguments.answer_s, arguments.longest_s)
    navigation = "" if navigation == "given" else navigation
    flight = Flight(
        ends,
        arguments.seed,
        out,
        faults,
        arguments.real_time,
        limits,
        navigation,
        arguments.delay_s,
        arguments.guidance,
    )
    try:
        with ExitStack() as stack:
            camera_ended: Ended = lambda: ""  # noqa: E731
            if not arguments.attach:
                camera_ended = stack.enter_context(camera(rig, arguments.seed, out, arguments.record))
            end, ground = fly(arguments.height, flight, camera_ended)
    except NotStarted as error:
        print(f"\n{error}", file=sys.stderr)
        return error.code
    judged = judgement(end, ground) if flight.navigation else {}
    if flight.navigation and arguments.compare:
        judged["others"] = {name: _other(name, arguments.height, flight, ground) for name in ("blind", "altimeter")}
    return _report(end, flight, judged, arguments.result)


def _wrong_use(arguments: argparse.Namespace, navigation: str) -> str:
    """Return why the arguments cannot be flown, and the remedy; "" where they can."""
    if arguments.real_time and navigation != "given":
        return "in real time only --navigation given flies; leave out one of both"
    if not arguments.guidance:
        return ""
    if navigation == "given":
        return "--guidance flies with the vehicle's own sensors: leave out --real-time and --navigation given"
    if arguments.compare:
        return "--compare flies the law of pilot.py with other sensors; leave out --guidance or --compare"
    try:
        GivenLaw(arguments.guidance)
    except LawFailed as failure:
        return f"--guidance {arguments.guidance} {failure}"
    return ""


def _other(navigation: str, height_m: float, flight: Flight, ground: Height) -> dict[str, object]:
    """Return the judgement of the same start flown with another navigation, without a camera."""
    end = fly_without_camera(height_m, flight.seed, PilotSettings(navigation, delay_s=flight.delay_s), ground)
    return {"touched": end.touched, "t_s": end.t_s} | judgement(end, ground)


def _rig_text(arguments: argparse.Namespace, ends: Ends) -> str:
    """Return the rig of a flight."""
    file = arguments.rig or _HERE / ("landing-realtime.toml" if arguments.real_time else "landing.toml")
    text = re.sub(r"(?m)^seed = 8$", f"seed = {arguments.terrain}", file.read_text())
    if arguments.lead_us:
        text = re.sub(r"(?m)^lead_us = \d+", f"lead_us = {arguments.lead_us}", text)
    return ends.rig("\n".join([text, *(table.read_text() for table in arguments.table)]))


def _report(end: TouchDown, flight: Flight, own: dict[str, object], result: Path | None) -> int:
    """Write and print the result of a flight, with its `judgement` where it has one; return the exit code."""
    out, judged = flight.out, verdict(end, flight.out, flight.faults.frames_lost) | own
    judged["navigation"] = flight.navigation or "given"
    judged |= {"guidance": flight.guidance} if flight.guidance else {}
    judged["soft"] = judged["soft"] and not (out / LAW_FAILED).exists()
    print(f"\n{_headline(end, soft=bool(judged['soft']))}; files in {out}")
    for sentence in (*reasons(judged), *judged["why"]):
        print(f"  {sentence}")
    for file in (out / "verdict.json", *([result] if result else [])):
        file.write_text(json.dumps(judged))
    if flight.real_time and (out / "standing.json").exists():
        (out / "latency.json").write_text(json.dumps(latencies(out), indent=1))
    try:
        print(f"page: {write_page(out)}")
    except ChartsLacking as error:
        print(f"no page: {error}")
    return 0 if judged["soft"] else 1


def _headline(end: TouchDown, *, soft: bool) -> str:
    if not end.touched:
        return f"NOT LANDED: the flight ended after {end.t_s:.1f} s, {end.state.position_m[2]:.1f} m up"
    return (
        f"{'landed' if soft else 'CRASHED'} after {end.t_s:.1f} s at {end.vertical_m_s:.2f} m/s down, "
        f"{end.horizontal_m_s:.2f} m/s along the ground"
    )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=float, default=300.0, help="m")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--terrain", type=int, default=8, help="seed of the ground")
    parser.add_argument("--rig", type=Path, default=None, help="landing.toml, or landing-realtime.toml in real time")
    parser.add_argument("--table", type=Path, action="append", default=[], help="more tables for the rig; repeat")
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--real-time", action="store_true")
    parser.add_argument(
        "--navigation",
        choices=[*NAVIGATIONS, "given"],
        default=None,
        help="given: exact attitude, no IMU",
    )
    parser.add_argument(
        "--guidance", default="", metavar="FILE.py:NAME", help="your law in the place of the pilot's: docs/landing.md"
    )
    parser.add_argument(
        "--delay-s", type=float, default=PilotSettings.delay_s, help="of a command, s; not in real time"
    )
    parser.add_argument("--compare", action="store_true", help="fly the start blind and with an altimeter too")
    parser.add_argument("--lead-us", type=int, default=0, help="instead of the rig's")
    parser.add_argument("--attach", nargs=3, metavar=("CAN_PORT", "POSE_PORT", "SERIAL"), default=None)
    parser.add_argument("--record", type=Path, default=None, help="write the events to this .npz")
    parser.add_argument("--result", type=Path, default=None, help="a copy of verdict.json")
    parser.add_argument("--fault", type=Fault.parse, action="append", default=[], help="see links.py; repeat")
    parser.add_argument(
        "--answer-s", type=float, default=120.0, help="time limit for an answer of the flight computer, in lockstep"
    )
    parser.add_argument("--longest-s", type=float, default=600.0, help="longest flight")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
