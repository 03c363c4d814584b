"""`evstim dynamics FMU`: simulate an FMU, and send its poses to a running rig, or run a rig in lockstep with it."""

from __future__ import annotations

import math
import socket
import threading
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cyclopts import Parameter

from emulator.cli.checks import failures
from emulator.cli.output import BAD_VERDICT, GOOD, WRONG_USE, Failure, Flag, Json, failing, parsed_address, print_result
from emulator.cli.run import summary, summary_lines
from emulator.cli.signals import ignore_stop_signals, stop_on_signals
from emulator.dynamics import flight
from emulator.dynamics.flight import FlightResult, Fmu, Pace, opened_inputs
from emulator.run.outcome import good, judge
from emulator.run.simulation import Simulation
from emulator.trajectory.pose import Pose
from firmware_protocol.pose_message import PoseMessage


class _Lockstep:
    """A rig, its links included, that goes on with each pose of its camera; both wait for each other."""

    def __init__(self, rig: str, step_s: float) -> None:
        self._rig, self._step_s = rig, step_s
        self.simulation: Simulation | None = None

    def send(self, message: PoseMessage) -> None:
        """Begin with the first pose, go on to each of the others."""
        pose = Pose(np.array(message.position_m), np.array(message.q_world_from_body))
        if self.simulation is None:
            self.simulation = Simulation(self._rig, links=True, camera=pose)
        else:
            self.simulation.step(round(message.counter * self._step_s * 1e6) - self.simulation.t_us, camera=pose)

    def close(self) -> None:
        """End the run."""
        if self.simulation is not None:
            self.simulation.close()


@Parameter(name="*")
@dataclass(frozen=True)
class Target:
    """Receiver of the poses.

    Attributes
    ----------
    to
        HOST:PORT at which a running rig receives poses; default: 127.0.0.1:10364.
    stamped
        Give poses the FMU's time as stream time. Default: each holds from its arrival.
    rig
        Run this rig in lockstep instead, its links included: the FMU moves its camera, and both wait for each other.
    """

    to: str | None = None
    stamped: Flag = False
    rig: str | None = None


_TO = "127.0.0.1:10364"


def dynamics(fmu: Path, /, *, map: Path, seconds: float, target: Target = Target(), json: Json = False) -> int:
    """Fly an FMU in real time, and send its poses to a rig with a path of kind "live"; or run a rig in lockstep.

    See docs/loops.md.

    Parameters
    ----------
    fmu
        A co-simulation FMU, 2.0 or 3.0.
    map
        TOML file that names the variables of the pose and the sources of its inputs.
    seconds
        How long it flies.
    """
    with (
        failures(),
        failing(WRONG_USE, OSError, at="--to"),
        failing(BAD_VERDICT, flight.FlightEnded),
        failing(WRONG_USE, flight.DynamicsError),
    ):
        if not 0 < seconds < 1e7:
            raise Failure(f"--seconds is {seconds:g}: give more than 0 and less than 1e7", WRONG_USE)
        end, run, complete = _flown(fmu, map, seconds, target)
    ignore_stop_signals()
    lines: list[str] = []
    result: dict[str, object] = {}
    if isinstance(end, FlightResult):
        x, y, z = end.last.position_m
        steps = f"{end.steps} step{'s' * (end.steps != 1)}"
        lines.append(f"{fmu.name}: {steps}, {end.t_s:g} s, at the end ({x:g}, {y:g}, {z:g}) m")
        result = {"steps": end.steps, "seconds": end.t_s, "position_m": end.last.position_m}
        result["q_world_from_body"] = end.last.q_world_from_body
    if run is not None:
        complete = complete and good(judge(run.rig.verdict, run.result))
        result["run"] = summary(run.rig, run.result)
        lines += summary_lines(run.rig, run.result)
    if isinstance(end, flight.FlightEnded):
        print_result(False, result, [] if json else lines)
        raise Failure(str(end), BAD_VERDICT, result) from end
    print_result(json, result, lines)
    return GOOD if complete else BAD_VERDICT


def _flown(
    file: Path, map_file: Path, seconds: float, target: Target
) -> tuple[FlightResult | flight.FlightEnded, Simulation | None, bool]:
    """Return the flight, or why the FMU ended it; the rig's run in lockstep, which has ended; whether all was flown.

    Raises FlightEnded where no rig has begun to run.
    """
    address, mapping = parsed_address("--to", target.to or _TO), flight.load_mapping(map_file)
    stopped = threading.Event()
    if target.rig is not None and (target.to is not None or target.stamped):
        raise Failure("--to and --stamped have no effect with --rig: leave them out", WRONG_USE)
    if not math.isclose(seconds, round(seconds / mapping.step_s) * mapping.step_s, rel_tol=1e-9):
        message = f"--seconds is {seconds:g}: give a multiple of step_s, which is {mapping.step_s:g} in {map_file}"
        raise Failure(message, WRONG_USE)
    if target.rig is not None and mapping.body:
        raise Failure(f"{map_file}: body = {mapping.body}: with --rig the FMU moves the camera, body 0", WRONG_USE)
    with opened_inputs(mapping, map_file.parent) as inputs, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        names = tuple(name for source in inputs for name in source.names)
        with Fmu(file, mapping, names) as unit:
            stop_on_signals(stopped.set)
            if target.rig is None:
                pace = Pace(seconds, target.stamped, flight.wall_clock(stopped.is_set))
                flown = flight.fly(unit, mapping, inputs, pace, lambda pose: out.sendto(bytes(pose), address))
                return flown, None, not stopped.is_set()
            pace = Pace(seconds, target.stamped, lambda _: not stopped.is_set())
            lockstep = _Lockstep(target.rig, mapping.step_s)
            try:
                with closing(lockstep):
                    flown = flight.fly(unit, mapping, inputs, pace, lockstep.send)
            except flight.FlightEnded as error:
                if lockstep.simulation is None:
                    raise
                return error, lockstep.simulation, False
            return flown, lockstep.simulation, not stopped.is_set()
