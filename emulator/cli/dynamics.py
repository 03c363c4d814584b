"""`evstim dynamics FMU`: simulate an FMU, and send its poses to a running rig."""

from __future__ import annotations

import dataclasses
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from emulator.cli.checks import failures, parsed_address
from emulator.cli.output import BAD_VERDICT, GOOD, WRONG_USE, Failure, Flag, Json, console, print_json
from emulator.cli.signals import ignore_stop_signals, stop_on_signals
from emulator.dynamics.flight import (
    DynamicsError,
    FlightEnded,
    FlightResult,
    Pace,
    fly,
    load_mapping,
    opened_inputs,
    wall_clock,
)
from emulator.dynamics.fmu import Fmu


class _Stop:
    """Record of a signal that ended the flight."""

    def __init__(self) -> None:
        self.requested = False

    def stop(self) -> None:
        self.requested = True


def dynamics(
    fmu: Path, /, *, map: Path, seconds: float, to: str = "127.0.0.1:10364", stamped: Flag = False, json: Json = False
) -> int:
    """Fly an FMU in real time, and send its poses to a rig with a path of kind "live". See docs/loops.md.

    Parameters
    ----------
    fmu
        A co-simulation FMU, 2.0 or 3.0.
    map
        TOML file that names the variables of the pose and the sources of its inputs.
    seconds
        How long it flies.
    to
        HOST:PORT at which the rig receives poses.
    stamped
        Give poses the FMU's time as stream time. Default: each holds from its arrival.
    """
    with failures(), _dynamics_failures():
        if not 0 < seconds < 1e7:
            raise Failure(f"--seconds is {seconds:g}: give more than 0 and less than 1e7", WRONG_USE)
        flown, complete = _flown(fmu, map, Pace(seconds, stamped, lambda _: True), to)
    ignore_stop_signals()
    result = {"steps": flown.steps, "seconds": flown.t_s, "position_m": flown.last.position_m}
    result["q_world_from_body"] = flown.last.q_world_from_body
    if json:
        print_json(result)
    else:
        x, y, z = flown.last.position_m
        ending = f"{flown.steps} steps, {flown.t_s:g} s, at the end ({x:g}, {y:g}, {z:g}) m"
        console.print(f"{fmu.name}: {ending}", markup=False)
    return GOOD if complete else BAD_VERDICT


def _flown(file: Path, map_file: Path, pace: Pace, to: str) -> tuple[FlightResult, bool]:
    address = parsed_address("--to", to)
    mapping, ending = load_mapping(map_file), _Stop()
    with opened_inputs(mapping, map_file.parent) as inputs, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        names = tuple(name for source in inputs for name in source.names)
        with Fmu(file, mapping, names) as unit:
            stop_on_signals(ending.stop)
            pace = dataclasses.replace(pace, waiting=wall_clock(lambda: ending.requested))
            flown = fly(unit, mapping, inputs, pace, lambda data: out.sendto(data, address))
    return flown, not ending.requested


@contextmanager
def _dynamics_failures() -> Iterator[None]:
    """Turn errors into Failure with its exit code."""
    try:
        yield
    except DynamicsError as error:
        raise Failure(str(error), WRONG_USE) from error
    except FlightEnded as error:
        raise Failure(str(error), BAD_VERDICT) from error
    except OSError as error:
        raise Failure(f"--to: {error.strerror or error}", WRONG_USE) from error
