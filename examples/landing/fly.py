"""Fly one landing: start the camera, the flight computer and the spacecraft; report the result.

    python fly.py [--height 300] [--seed 1] [--terrain 8] [--rig landing.toml] [--out DIR] [--real-time]

By default the vehicle flies with its own sensors and the camera's events (`--navigation events`). The seed draws the
start, the errors of navigation, sensors, mass, gravity and engine, and the camera's noise. In DIR: truth.csv (the
vehicle), computer.jsonl (the computer's turns), summary.json (the camera's run), verdict.json, page.html; in real time
latency.json too. `evstim campaign` attaches this program to a camera that runs already.

Exit codes: 0 landed within the bounds (given: below 1 m/s); 1 not; 2 wrong use or wrong rig; 3 something did not start.
"""

from __future__ import annotations

import argparse
import json
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import msgspec
from flight_computer import Settings
from links import Connection, Fault, Faults, opened_bus
from pilot import LAW_FAILED, NAVIGATIONS, GivenLaw, LawFailed
from report import judgement, latencies, reasons, rows_of, verdict, write_page
from sensors import SensorErrors, Sensors
from spacecraft import ANSWER_S, LONGEST_S, Mission, RealTimeSpacecraft, Spacecraft, TouchDown, fly_without_camera
from vehicle import Height, State

from emulator.report.page import ChartsLacking
from emulator.rig.loading import RigError, load_rig
from emulator.scene.terrain.world import build_ground

_WRONG_USE, _LACKING = 2, 3  # exit codes
_HERE = Path(__file__).parent
_READY_S, _END_S = 600.0, 60.0
_COLUMNS = "t_s,x_m,y_m,z_m,ground_m,vx_m_s,vy_m_s,vz_m_s,thrust_n,mass_kg,qw,qx,qy,qz"

Ends = tuple[int, int, str]
"""Addresses of the links: the bus's TCP port, the UDP port of poses, the serial line."""


def ends_of(options: argparse.Namespace, out: Path) -> Ends:
    """Return the addresses of a camera that runs already; else free ports, and a serial line in a folder."""
    if options.attach:
        can_port, pose_port, serial = options.attach
        return int(can_port), int(pose_port), serial
    with socket.create_server(("127.0.0.1", 0)) as bus, socket.socket(type=socket.SOCK_DGRAM) as poses:
        poses.bind(("127.0.0.1", 0))
        return bus.getsockname()[1], poses.getsockname()[1], str(out / "serial")


@contextmanager
def running(
    name: str, arguments: Sequence[object], ready: Path, output: TextIO | None = None
) -> Iterator[Callable[[], str]]:
    """Run a Python program until the block ends; it has started when the file `ready` is there.

    Gives a function that returns "" while it runs, then a sentence about its end. Raises SystemExit, with the exit code
    by cause, where it does not start.
    """
    ready.unlink(missing_ok=True)
    with subprocess.Popen([sys.executable, *map(str, arguments)], stdout=output) as process:

        def ended() -> str:
            if (code := process.poll()) is None:
                return ""
            return f"{name} has ended with {f'code {code}' if code >= 0 else f'signal {-code}'}"

        try:
            end_s = time.monotonic() + _READY_S
            while not ready.exists():
                if process.poll() is not None or time.monotonic() > end_s:
                    print(f"\nfly.py: {name} has not started, see above", file=sys.stderr)
                    raise SystemExit(_WRONG_USE if process.poll() == _WRONG_USE else _LACKING)
                time.sleep(0.05)
            yield ended
        finally:
            process.terminate()
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()  # a law of the user's may hold the interpreter


def fly(options: argparse.Namespace, out: Path, ends: Ends, ground: Height, faults: Faults) -> TouchDown:
    """Fly a landing; return its end. Its files are in `out`, the rig among them."""
    given, seed, (can_port, pose_port, serial) = options.navigation == "given", options.seed, ends
    mission = (Mission.with_given_attitude if given else Mission.drawn)(options.height, seed)
    faults_of_computer = tuple(fault for fault in options.fault if fault.kind in ("crash", "hang"))
    how = options.navigation, options.guidance, options.real_time, faults_of_computer
    settings = Settings(can_port, serial, seed, mission.known, *how)
    (out / "computer.json").write_bytes(msgspec.json.encode(settings))
    failed = out / LAW_FAILED
    failed.unlink(missing_ok=True)
    (out / "last_events.npz").unlink(missing_ok=True)
    with ExitStack() as stack:
        processes: list[Callable[[], str]] = []
        if not options.attach:
            run = ["-m", "evstim", "run", out / "landing.toml", "--json", "--seconds", 0, "--seed", seed]
            run += ["--ready-file", out / "ready", *(["--record", options.record] if options.record else [])]
            summary = stack.enter_context((out / "summary.json").open("w"))
            processes.append(stack.enter_context(running("evstim", run, out / "ready", summary)))
        bus = stack.enter_context(opened_bus(can_port))
        computer = [_HERE / "flight_computer.py", out / "computer.json"]
        processes.append(stack.enter_context(running("the flight computer", computer, out / "computer.ready")))
        truth = stack.enter_context((out / "truth.csv").open("w"))
        print(_COLUMNS, file=truth)

        def trouble() -> str:
            sentences = [sentence for ended in processes if (sentence := ended())]
            return failed.read_text() if sentences and failed.exists() else "; ".join(sentences)

        connection = Connection(bus, pose_port, trouble, faults)
        sensors = None if given else Sensors(SensorErrors(), mission.lander, seed, ground)
        vehicle = (RealTimeSpacecraft if options.real_time else Spacecraft)(
            mission.lander, mission.state, connection, sensors, options.longest_s, options.answer_s
        )
        end = vehicle.land(ground, partial(_record, truth, ground))
    if options.real_time and (rows := rows_of(out)):
        (out / "latency.json").write_text(json.dumps(latencies(vehicle.origin_ns, vehicle.commands, rows)))
    return end


def _record(truth: TextIO, ground: Height, t_s: float, state: State) -> None:
    """Write time and state of a turn to a file, and print them."""
    x, y, z = state.position_m.tolist()
    figures = (t_s, x, y, z, ground(x, y), *state.velocity_m_s, state.thrust_n, state.mass_kg, *state.attitude)
    print(",".join(f"{figure:.6g}" for figure in figures), file=truth, flush=True)
    print(f"\r{t_s:6.1f} s  {z:8.1f} m  {state.velocity_m_s[2]:7.2f} m/s", end="")


def ground_of(rig: Path) -> Height:
    """Return the height of a rig's ground, a terrain, under a place; off its map that of the middle."""
    ground = build_ground(load_rig(str(rig)).scene)
    return lambda x_m, y_m: ground.height_m(x_m, y_m) or 0.0


def main() -> int:
    """Fly once."""
    options = _options()
    out = (options.out or Path(tempfile.mkdtemp(prefix="landing-"))).resolve()
    out.mkdir(parents=True, exist_ok=True)
    ends = ends_of(options, out)
    (out / "landing.toml").write_text(_rig_text(options, ends))
    faults = Faults(options.fault, options.seed)
    try:
        ground = ground_of(out / "landing.toml")
    except RigError as error:
        print(f"fly.py: {error}", file=sys.stderr)
        return _WRONG_USE
    end = fly(options, out, ends, ground, faults)
    judged = verdict(end, out, faults.frames_lost)
    if options.navigation != "given":
        judged |= judgement(end, ground)
    if options.navigation != "given" and options.compare:
        judged["others"] = {}
        for name in ("blind", "altimeter"):  # the same start, without a camera
            other = fly_without_camera(options.height, options.seed, name, ground)
            judged["others"][name] = {"touched": other.touched, "t_s": other.t_s} | judgement(other, ground)
    return _report(end, judged, options, out)


def _rig_text(options: argparse.Namespace, ends: Ends) -> str:
    """Return the rig of a flight, with its links' addresses."""
    file = options.rig or _HERE / ("landing-realtime.toml" if options.real_time else "landing.toml")
    text = re.sub(r"(?m)^seed = 8$", f"seed = {options.terrain}", file.read_text())
    for name, end in zip(("29536", "10364", "/tmp/evstim-landing"), ends, strict=True):
        text = text.replace(name, str(end))
    return "\n".join([text, *(table.read_text() for table in options.table)])


def _report(end: TouchDown, judged: dict[str, Any], options: argparse.Namespace, out: Path) -> int:
    """Write and print the verdict of a flight; return the exit code."""
    judged["navigation"] = options.navigation
    judged |= {"guidance": options.guidance} if options.guidance else {}
    judged["soft"] = judged["soft"] and not (out / LAW_FAILED).exists()
    text = f"NOT LANDED: the flight ended after {end.t_s:.1f} s, {end.state.position_m[2]:.1f} m up"
    if end.touched:
        speeds = f"{end.vertical_m_s:.2f} m/s down, {end.horizontal_m_s:.2f} m/s along the ground"
        text = f"{'landed' if judged['soft'] else 'CRASHED'} after {end.t_s:.1f} s at {speeds}"
    print(f"\n{text}; files in {out}", *reasons(judged), *judged["why"], sep="\n  ")
    for file in (out / "verdict.json", *([options.result] if options.result else [])):
        file.write_text(json.dumps(judged))
    try:
        print(f"page: {write_page(out)}")
    except ChartsLacking as error:
        print(f"no page: {error}")
    return 0 if judged["soft"] else 1


def _options() -> argparse.Namespace:
    """Return the options; an end with exit code 2, the reason and the remedy for those that cannot be flown."""
    parser = argparse.ArgumentParser(
        usage="%(prog)s [options]", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--height", type=float, default=300.0, help="m")
    add("--seed", type=int, default=1)
    add("--terrain", type=int, default=8, help="seed of the ground")
    add("--rig", type=Path, help="landing.toml, or landing-realtime.toml in real time")
    add("--table", type=Path, action="append", default=[], help="more tables for the rig, such as [[faults]]; repeat")
    add("--out", type=Path)
    add("--real-time", action="store_true")
    add("--navigation", choices=[*NAVIGATIONS, "given"], help="given: exact attitude, no IMU; so in real time")
    add("--guidance", default="", metavar="FILE.py:NAME", help="your law in the place of the pilot's: docs/landing.md")
    add("--compare", action="store_true", help="fly the start blind and with an altimeter too")
    add("--attach", nargs=3, metavar=("CAN_PORT", "POSE_PORT", "SERIAL"), help="of a camera that runs already")
    add("--record", type=Path, help="write the events to this .npz")
    add("--result", type=Path, help="a copy of verdict.json")
    add("--fault", type=Fault.parse, action="append", default=[], help="crash@12 and others, see links.py; repeat")
    add("--answer-s", type=float, default=ANSWER_S, help="time limit for an answer of the flight computer, in lockstep")
    add("--longest-s", type=float, default=LONGEST_S, help="longest flight")
    options = parser.parse_args()
    options.navigation = options.navigation or ("given" if options.real_time else "events")
    if options.real_time and options.navigation != "given":
        parser.error("in real time only --navigation given flies; leave out one of both")
    if options.guidance and options.navigation == "given":
        parser.error("--guidance flies with the vehicle's own sensors: leave out --real-time and --navigation given")
    if options.guidance and options.compare:
        parser.error("--compare flies the law of pilot.py with other sensors; leave out --guidance or --compare")
    if options.guidance:
        try:
            GivenLaw(options.guidance)
        except LawFailed as failure:
            parser.error(f"--guidance {options.guidance} {failure}")
    return options


if __name__ == "__main__":
    sys.exit(main())
