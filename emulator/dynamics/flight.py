"""A flight: an FMU steps, and each pose that comes of it is sent."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from emulator.dynamics.failures import FlightEnded
from emulator.dynamics.inputs import Inputs
from emulator.dynamics.mapping import Mapping
from firmware_protocol.pose_message import NOW, PoseMessage, PoseMessageError

__all__ = ["Flown", "Pace", "Stepping", "fly", "wall_clock"]

_UNIT_WITHIN = 0.01


class Stepping(Protocol):
    """Dynamics that go on step by step."""

    outputs: dict[str, float]

    def step(self, t_s: float, step_s: float, inputs: dict[str, float]) -> None:
        """Set inputs and go on."""


@dataclass(frozen=True)
class Pace:
    """How a flight goes.

    Attributes
    ----------
    seconds : of the FMU's time.
    stamped : whether poses carry the FMU's time as stream time; otherwise they hold from their arrival.
    waiting : waits until the flight has lasted so many seconds; tells whether it should go on.
    """

    seconds: float
    stamped: bool
    waiting: Callable[[float], bool]


@dataclass(frozen=True)
class Flown:
    """What a flight was."""

    steps: int
    t_s: float
    last: PoseMessage


def fly(
    unit: Stepping, mapping: Mapping, inputs: Sequence[Inputs], pace: Pace, send: Callable[[bytes], object]
) -> Flown:
    """Fly until the time is over or `pace` ends it; raises FlightEnded."""
    steps, number = round(pace.seconds / mapping.step_s), 0
    pose = _pose(unit, mapping, number, pace)
    send(bytes(pose))
    while number < steps and pace.waiting((number + 1) * mapping.step_s):
        t_s = number * mapping.step_s
        given = {name: value for one in inputs for name, value in one.at(t_s).items()}
        unit.step(t_s, mapping.step_s, given)
        number += 1
        pose = _pose(unit, mapping, number, pace)
        send(bytes(pose))
    return Flown(number, number * mapping.step_s, pose)


def _pose(unit: Stepping, mapping: Mapping, number: int, pace: Pace) -> PoseMessage:
    """Return the pose of now; raises FlightEnded where the FMU's numbers are none."""
    t_s = number * mapping.step_s
    wrong = [name for name in mapping.outputs if not math.isfinite(unit.outputs[name])]
    if wrong:
        raise FlightEnded(f"at {t_s:g} s the FMU gives {wrong[0]} = {unit.outputs[wrong[0]]}: no pose was sent for it")
    x, y, z = (_number(unit, one) for one in mapping.position_m)
    w, i, j, k = (_number(unit, one) for one in mapping.q_world_from_body)
    length = math.hypot(w, i, j, k)
    if abs(length - 1) > _UNIT_WITHIN:
        raise FlightEnded(f"at {t_s:g} s q_world_from_body has length {length:.4g}: a unit quaternion is needed")
    attitude = w / length, i / length, j / length, k / length
    t_ns = round(t_s * 1e9) if pace.stamped else NOW
    try:
        return PoseMessage(t_ns, (x, y, z), attitude, body=mapping.body, counter=number % (1 << 32))
    except PoseMessageError as error:
        raise FlightEnded(f"at {t_s:g} s: {error}") from error


def _number(unit: Stepping, one: str | float) -> float:
    return unit.outputs[one] if isinstance(one, str) else float(one)


def wall_clock(stop: Callable[[], bool]) -> Callable[[float], bool]:
    """Return a wait for the wall's clock from now on, until `stop` says so."""
    begun_s = time.monotonic()

    def wait(t_s: float) -> bool:
        while (rest_s := begun_s + t_s - time.monotonic()) > 0 and not stop():
            time.sleep(min(rest_s, 0.1))
        return not stop()

    return wait
