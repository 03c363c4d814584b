"""The pilot of a vehicle with sensors of its own: frames of the bus and motions from events in, commands out.

    a_up   = D*^2 h (half of it where thrust limits the divergence) + k (s - D* h) + g       s: speed downwards
    a_east = -c (v_east - w_east),  w = -place / 20 s, limited; the same to the north

Height, speed and place are those of the filter (navigation.py), predicted for the time at which the command acts from
the commands that were sent. D* and k are those of guidance.py. Below 8 m the vehicle falls slowly, straight.

A law of the user's, FILE.py:NAME, can take the place of this one: docs/landing.md.
"""

from __future__ import annotations

import math
import runpy
import sys
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import TypeVar

import frames
import numpy as np
from divergence import Motion
from guidance import DIVERGENCE_1_S, ENGINE_S, FINAL_M, GAIN_1_S, wanted_1_s, window_s
from navigation import Filter, Known, of_events, of_range, of_star
from sensors import PERIOD_S, SensorErrors
from vehicle import GRAVITY_M_S2, Vector

LAW_FAILED = "law_failed.txt"
"""File of a flight whose given law has failed: the sentence about it."""

_CALL_S, _LOAD_S = 2.0, 60.0
_MOST_M_S2 = 32.0  # a command's frame on the bus has room for it
_MOST_TEXT = 160
_MODULE = "given_law_of_user"

Result = TypeVar("Result")


@dataclass(frozen=True)
class LawInput:
    """State from navigation, predicted for the time at which the command of this turn acts."""

    t_s: float  # that time, since the start
    position_m: Vector  # place beside the site and height above it, (east, north, up), (3,)
    velocity_m_s: Vector  # (3,), in the same axes
    attitude: Vector  # newest, unit quaternion world from body, scalar first, (4,)
    position_sigma_m: Vector  # 1 sigma of each axis by the filter, (3,)
    velocity_sigma_m_s: Vector
    turn_s: float  # from one command to the next


class LawFailed(Exception):
    """A law cannot be loaded, or has failed; the message is the predicate of a sentence about it."""


class GivenLaw:
    """A law, FILE.py:NAME, called in a thread of its own, so that one that hangs does not stop the flight computer.

    Raises LawFailed, with the remedy, where it cannot be loaded.
    """

    def __init__(self, text: str) -> None:
        file, _, self._name = text.rpartition(":")
        self._path = Path(file).resolve()
        if not self._name.isidentifier() or self._path.suffix != ".py":
            raise LawFailed("is not FILE.py:NAME: give a file and the law's name in it, such as simple_law.py:Law")
        if not self._path.is_file():
            raise LawFailed(f"names no file: give the path of a file that exists, {self._path} does not")
        self._law: Callable[[LawInput], object] = self._within(_LOAD_S, self._loaded)

    def __call__(self, state: LawInput) -> Vector:
        """Return the acceleration that the law wants, (3,), m/s2; raises LawFailed."""
        return self._within(_CALL_S, lambda: _acceleration(self._law(state)))

    def _within(self, seconds: float, call: Callable[[], Result]) -> Result:
        """Return the result of a call; raises LawFailed for any exception of it, and when it takes longer."""
        future: Future[Result] = Future()

        def work() -> None:
            try:
                future.set_result(call())
            except BaseException as error:  # noqa: BLE001  a law may raise anything, SystemExit too
                future.set_exception(error)

        thread = Thread(target=work, daemon=True)
        thread.start()
        for _ in range(2):  # a machine that stands still may take away one half
            thread.join(seconds / 2)
        if not future.done():
            raise LawFailed(f"did not return within {seconds:g} s")
        if (error := future.exception()) is None:
            return future.result()
        raise error if isinstance(error, LawFailed) else LawFailed(f"raised {self._described(error)}")

    def _described(self, error: BaseException) -> str:
        """Return kind and message of an error, and the line of the law's file that it came from."""
        calls = traceback.extract_tb(error.__traceback__)
        lines = [call.lineno for call in calls if call.filename == str(self._path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        message = " ".join(str(error).split())[:_MOST_TEXT]
        return f"{type(error).__name__}: {message}" + (f", in line {line} of {self._path.name}" if line else "")

    def _loaded(self) -> Callable[[LawInput], object]:
        sys.path.append(str(self._path.parent))  # for what the file imports from beside it
        found = runpy.run_path(str(self._path), run_name=_MODULE)
        if self._name not in found:
            names = [name for name, value in found.items() if getattr(value, "__module__", "") == _MODULE]
            choice = f"give a name that it defines: {', '.join(names)}" if names else "it defines none"
            raise LawFailed(f"names nothing in {self._path.name}: {choice}")
        law = found[self._name]
        if isinstance(law, type):
            law = law()
        if not callable(law):
            raise LawFailed("cannot be called: give a function, or a class with a method __call__(self, state)")
        return law


def _acceleration(value: object) -> Vector:
    """Return what a law returned as an array, (3,); raises LawFailed."""
    shown = " ".join(repr(value).split())[:_MOST_TEXT]
    try:
        command = np.array(value, np.float64)
    except (TypeError, ValueError):
        command = np.empty(0)
    if command.shape != (3,) or not np.isfinite(command).all():
        raise LawFailed(f"returned {shown}, not three finite numbers (east, north, up)")
    if np.abs(command).max() > _MOST_M_S2:
        raise LawFailed(f"returned {shown}, beyond {_MOST_M_S2:g} m/s2")
    return command


NAVIGATIONS = {
    "blind": frozenset[str](),
    "altimeter": frozenset({"altimeter"}),
    "events": frozenset({"events"}),
    "both": frozenset({"altimeter", "events"}),
}
"""Sensors beside IMU and star tracker, by the name of the navigation."""

TURN_S = 0.2
"""Time from one command to the next."""

DELAY_S = 0.1
"""Time from the newest sample of a turn until its command acts."""

_PLACE_1_S, _SIDEWAYS_1_S, _MOST_SIDEWAYS_M_S = 0.05, 0.3, 1.5
_MOST_TILT = 0.05
_LEAST_M = 1.0
_RELATIVE, _LEAST_DOWN_1_S, _LEAST_ASIDE_1_S = 0.025, 0.0007, 0.001
_RELIEF_M = 0.5
_HOLD_S = 1.0


class Pilot:
    """One descent, from the state known at its start, with the sensors of a name of NAVIGATIONS.

    `law` gives the wanted acceleration, (3,), in the place of `wanted_m_s2`.
    """

    begins_s = 0.5  # before it, events show the camera's start and not the ground

    def __init__(self, known: Known, navigation: str, law: Callable[[LawInput], Vector] | None = None) -> None:
        self._used, self._law = NAVIGATIONS[navigation], law or wanted_m_s2
        self.uses_events = "events" in self._used
        self.filter = Filter(known, SensorErrors())
        self._turn = np.zeros(3)
        self._sent: deque[tuple[float, Vector]] = deque([(-math.inf, np.array([0.0, 0.0, GRAVITY_M_S2]))], maxlen=20)
        self._motion: Motion | None = None  # of this turn
        self._seen_s = self.begins_s

    def take_frame(self, identifier: int, data: bytes) -> None:
        """Take a frame of the bus; raises struct.error for one of a wrong length."""
        newest = self.filter.newest
        if identifier == frames.TURN:
            words, _ = frames.unpack_words(data)
            self._turn = words * frames.TURN_RAD
        elif identifier == frames.PUSH:
            words, number = frames.unpack_words(data)
            self.filter.sample(frames.nearest_number(number, newest), self._turn, words * frames.PUSH_M_S)
        elif identifier == frames.STAR:
            q, number = frames.unpack_attitude(data)
            self.filter.measure(frames.nearest_number(number, newest), of_star(q, self.filter.errors))
        elif identifier == frames.RANGE and "altimeter" in self._used:
            words, number = frames.RANGE_FRAME.unpack(data)
            measured = of_range(words * frames.RANGE_M, self.filter.errors, _RELIEF_M)
            self.filter.measure(frames.nearest_number(number, newest), measured)

    def complete(self, now_s: float) -> bool:
        """Return True when the samples of the turn that began at a time have come."""
        return self.filter.newest >= round((now_s + TURN_S) / PERIOD_S) - 1

    def attitudes(self, since_s: float) -> list[tuple[float, Vector]]:
        """Return times, s, and attitudes, world from body, from a time until the newest sample, every second one."""
        first = max(round(since_s / PERIOD_S) - 2, 0)
        numbers = range(self.filter.newest, first - 1, -2)
        return [(k * PERIOD_S, self.filter.at(k).attitude) for k in reversed(numbers)]

    def guess(self, at_s: float) -> Motion:
        """Return the motion over height that the filter has for a time: the estimator begins there."""
        then = self.filter.at(round(at_s / PERIOD_S))
        east, north, up = (then.velocity_m_s / max(float(then.position_m[2]), _LEAST_M)).tolist()
        return Motion(east, -north, -up, math.inf, at_s, 0)

    def window_s(self, now_s: float) -> float:
        """Return the length of the next window of events."""
        motion = self.guess(now_s)
        return window_s(motion.down, motion.east, motion.south)

    def take_motion(self, motion: Motion, now_s: float, length_s: float) -> None:
        """Take the motion of a window of events."""
        if self.uses_events and motion.reliable:
            self._motion, self._seen_s = motion, now_s
            sigma = _RELATIVE * abs(motion.down) + np.array([_LEAST_ASIDE_1_S, _LEAST_ASIDE_1_S, _LEAST_DOWN_1_S])
            variance = sigma**2 * max(1.0, length_s / TURN_S)
            velocity_1_s = np.array([motion.east, motion.south, motion.down])
            self.filter.measure(round(motion.at_s / PERIOD_S), of_events(velocity_1_s, variance))

    def command_m_s2(self, now_s: float, period_s: float) -> Vector:
        """Return the acceleration wanted when the command acts, (east, north, up), gravity's not included.

        The turn began at `now_s`, and its newest sample is `period_s` later.
        """
        acts_s, now = now_s + period_s + DELAY_S, self.filter.now
        position, velocity = self._predicted(acts_s + ENGINE_S)
        sigma = np.sqrt(np.diag(now.covariance))
        state = LawInput(acts_s + ENGINE_S, position, velocity, now.attitude.copy(), sigma[:3], sigma[3:6], TURN_S)
        command = self._law(state)
        self._sent.append((acts_s, command))
        return command

    def estimate(self) -> bytes:
        """Return the data of the newest attitude, which is sent before a command: for the attitude control."""
        return frames.pack_attitude(self.filter.now.attitude, self.filter.newest)

    def row(self, now_s: float) -> dict[str, object]:
        """Return what belongs into the log of a turn."""
        now, motion, self._motion = self.filter.now, self._motion, None
        row: dict[str, object] = {"estimate_s": self.filter.newest * PERIOD_S}
        row |= {"lost": self.uses_events and now_s - self._seen_s > _HOLD_S} | (motion.row() if motion else {})
        row |= {"position_m": now.position_m.tolist(), "velocity_m_s": now.velocity_m_s.tolist()}
        return row | {"attitude": now.attitude.tolist(), "sigma": np.sqrt(np.diag(now.covariance)).tolist()}

    def _predicted(self, until_s: float) -> tuple[Vector, Vector]:
        """Return position and velocity at a time, from the commands that act until then."""
        now, t_s = self.filter.now, self.filter.newest * PERIOD_S
        position, velocity = now.position_m, now.velocity_m_s
        while t_s < until_s - 1e-9:
            step_s = min(PERIOD_S, until_s - t_s)
            acting = [command for acts_s, command in self._sent if acts_s + ENGINE_S <= t_s + 1e-9]
            change = ((acting or [self._sent[0][1]])[-1] - (0.0, 0.0, GRAVITY_M_S2)) * step_s
            position, velocity = position + (velocity + change / 2) * step_s, velocity + change
            t_s += step_s
        return position, velocity


def wanted_m_s2(state: LawInput) -> Vector:
    """Return the acceleration that the example's law wants, (3,), gravity's not included."""
    height_m = max(float(state.position_m[2]), _LEAST_M)
    wanted = wanted_1_s(height_m)
    steady = wanted**2 * height_m * (0.5 if wanted < DIVERGENCE_1_S else 1.0) * (height_m > FINAL_M)
    up = max(steady + GAIN_1_S * (-state.velocity_m_s[2] - wanted * height_m) + GRAVITY_M_S2, 0.1)
    to_place = -_PLACE_1_S * state.position_m[:2] * (height_m > FINAL_M)
    to_place *= min(1.0, _MOST_SIDEWAYS_M_S / max(float(np.hypot(*to_place)), 1e-9))
    aside = _SIDEWAYS_1_S * (to_place - state.velocity_m_s[:2])
    aside *= min(1.0, _MOST_TILT * up / max(float(np.hypot(*aside)), 1e-9))
    return np.array([*aside, up])
