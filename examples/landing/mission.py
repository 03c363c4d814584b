"""A landing with the vehicle's own sensors: its start by a seed, the spacecraft with sensors, the judgement.

    python mission.py --height 500 --flights 100 --navigation blind altimeter

flies many without a camera: the frames are the same bytes, but go from one object to the other, not over the bus.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from divergence import Motion
from frames import pack_command, unpack_attitude, unpack_command
from guidance import Law
from navigation import Known
from pilot import Pilot, PilotSettings
from sensors import PERIOD_S, SensorErrors, Sensors, turn_of
from spacecraft import FOOT_M, LEFT_ALONE_S, USUAL, Limits, TouchDown, flies
from vehicle import GRAVITY_M_S2, NO_TURN, Lander, State, Vector, advance, matrix, product

__all__ = ["Bounds", "Mission", "SensingSpacecraft", "Uncertainty", "fly_without_camera", "judgement"]

PERIODS = 10  # of the IMU in a turn
_PICTURE_PERIODS = 2
_FEET_M = 1.5
_PLACES = 9

Height = Callable[[float, float], float]
Record = Callable[[float, State], None]


@dataclass(frozen=True)
class Uncertainty:
    """Errors at the start and of the vehicle, 1 sigma (normal).

    Attributes
    ----------
    height : of the known height, relative.
    place_m, velocity_m_s : of the known place and velocity, each axis.
    offset_m, sideways_m_s : of the true place beside the site, and of the true speed along the ground, each axis.
    mass : of the mass that the engine's control assumes, relative. thrust : of the engine's scale.
    gravity_m_s2 : each axis: strength and direction.
    """

    height: float = 0.05
    place_m: float = 5.0
    velocity_m_s: float = 0.7
    offset_m: float = 10.0
    sideways_m_s: float = 0.5
    mass: float = 0.02
    thrust: float = 0.015
    gravity_m_s2: float = 0.002


@dataclass(frozen=True)
class Mission:
    """A start: the true state and vehicle, and the state from navigation."""

    state: State
    lander: Lander
    known: Known

    @classmethod
    def drawn(cls, height_m: float, seed: int, errors: Uncertainty | None = None) -> Mission:
        """Return the start of a seed; the height is above the site."""
        errors, draw = errors or Uncertainty(), np.random.default_rng([seed, 28])
        down = Law().wanted_1_s(height_m) * height_m * draw.uniform(0.9, 1.1)
        velocity = np.array([*draw.normal(0, errors.sideways_m_s, 2), -down])
        place = np.array([*draw.normal(0, errors.offset_m, 2), height_m])
        mass_kg = float(draw.uniform(900, 1100))
        gravity = np.array([0.0, 0.0, -GRAVITY_M_S2]) + draw.normal(0, errors.gravity_m_s2, 3)
        lander = Lander(
            thrust_scale=float(1 + draw.normal(0, errors.thrust)),
            mass_error_kg=float(mass_kg * draw.normal(0, errors.mass)),
            gravity_m_s2=tuple(gravity.tolist()),
        )
        known_place = place + (*draw.normal(0, errors.place_m, 2), height_m * draw.normal(0, errors.height))
        known_velocity = velocity + draw.normal(0, errors.velocity_m_s, 3)
        known = Known(
            tuple(known_place.tolist()),
            tuple(known_velocity.tolist()),
            errors.place_m,
            errors.height * height_m,
            errors.velocity_m_s,
        )
        return cls(State(place, velocity, mass_kg=mass_kg, thrust_n=mass_kg * GRAVITY_M_S2), lander, known)


class Ways(Protocol):
    """Links of a spacecraft with sensors."""

    def pose(self, t_s: float, state: State) -> None:
        """Send the pose of a time."""

    def frame(self, t_s: float, identifier: int, data: bytes) -> None:
        """Send a frame of a sensor."""

    def sync(self) -> None:
        """Send a SYNC."""

    def trouble(self) -> str:
        """Return a text that names the process that has ended."""

    def answer(self, t_s: float, limit_s: float) -> tuple[Vector, int, bytes] | None:
        """Return command, its turn, and the data of the newest estimate; None when it was lost."""


class SensingSpacecraft:
    """One vehicle in lockstep, which sends nothing but its sensors' samples.

    A command acts `delay_s` after the answer's turn; attitude control turns by the gyroscope from the flight computer's
    newest estimate on.

    Parameters
    ----------
    mission : start and vehicle.
    links : to camera and flight computer.
    sensors : of the vehicle.
    delay_s : from the end of a turn until its command acts.
    limits : longest waiting times.
    """

    def __init__(
        self, mission: Mission, links: Ways, sensors: Sensors, delay_s: float = 0.1, limits: Limits = USUAL
    ) -> None:
        self._lander, self.state, self._links, self._sensors = mission.lander, mission.state, links, sensors
        self._delay_s, self._limits, self._full_kg = delay_s, limits, mission.state.mass_kg
        self._number = self._turn = 0
        self._commands: list[tuple[float, Vector]] = [(0.0, np.array([0.0, 0.0, GRAVITY_M_S2]))]
        self._attitude = NO_TURN  # of the attitude control; navigation's at the start
        self._turns: list[Vector] = [NO_TURN]
        self._why: list[str] = []
        self._end_s = limits.longest_s
        links.pose(0.0, self.state)

    @property
    def t_s(self) -> float:
        """Time of the state."""
        return self._number * PERIOD_S

    def land(self, ground_m: Height, record: Record) -> TouchDown:
        """Fly to the ground, whose height depends on the place; `record` receives time and state of each turn."""
        while self.t_s < self._end_s:
            for _ in range(PERIODS):
                if not self._step():
                    return self._end(touched=False)
                if self._stands(ground_m):
                    return self._end(touched=True)
            self._turn += 1
            self._links.sync()
            record(self.t_s, self.state)
            self._take_answer()
        self._why.append(f"still flying after {self.t_s:.0f} s")
        return self._end(touched=False)

    def _step(self) -> bool:
        """Advance by one period; False when the dynamics give no numbers."""
        error = product(self.state.attitude * (1, -1, -1, -1), self._attitude)
        acting = [command for acts_s, command in self._commands if acts_s <= self.t_s + 1e-9][-1]
        before, self.state = self.state, advance(self._lander, self.state, acting, PERIOD_S, error)
        if not flies(self.state):
            self._why.append(f"the dynamics gave no numbers at {self.t_s:.2f} s")
            return False
        self._number += 1
        self._turns.append(turn_of(self._sensors.turn_rad(self._number, before, self.state)))
        self._attitude = product(self._attitude, self._turns[-1])
        self._sensors.take(self._number, before, self.state)
        for identifier, data in self._sensors.due(self._number):
            self._links.frame(self.t_s, identifier, data)
        if self._number % _PICTURE_PERIODS == 0:
            self._links.pose(self.t_s, self.state)
        return True

    def _stands(self, ground_m: Height) -> bool:
        x, y, z = self.state.position_m.tolist()
        return z - ground_m(x, y) <= FOOT_M

    def _take_answer(self) -> None:
        """Take the answer to this turn's SYNC; without one the last command holds."""
        if self._why:
            return
        try:
            while (answer := self._links.answer(self.t_s, self._limits.answer_s)) is not None:
                command, turn, estimate = answer
                if turn == self._turn % (1 << 16):
                    self._commands = [*self._commands[-3:], (self.t_s + self._delay_s, command)]
                    self._follow(estimate)
                    return
        except TimeoutError:
            silent = self._links.trouble() or f"the flight computer did not answer within {self._limits.answer_s:g} s"
            self._why.append(f"{silent}, at {self.t_s:.1f} s and {self.state.position_m[2]:.1f} m: no command since")
            self._end_s = min(self.t_s + LEFT_ALONE_S, self._end_s)

    def _follow(self, estimate: bytes) -> None:
        """Take the flight computer's attitude, turned by the gyroscope since its time."""
        if not estimate:
            return
        q, number = unpack_attitude(estimate)
        for turn in self._turns[self._number - (self._number - number) % (1 << 16) + 1 :]:
            q = product(q, turn)
        self._attitude = q / np.linalg.norm(q)

    def _end(self, *, touched: bool) -> TouchDown:
        return TouchDown(self.t_s, self.state, touched, self._full_kg - self.state.mass_kg, tuple(self._why))


@dataclass(frozen=True)
class Bounds:
    """Bounds of a landing: speeds, m/s; tilt at contact, degrees; place, m. Of the site: slope, degrees; rock, m."""

    vertical_m_s: float = 1.0
    horizontal_m_s: float = 0.5
    tilt_deg: float = 5.0
    place_m: float = 25.0
    slope_deg: float = 12.0
    rock_m: float = 0.4


def judgement(end: TouchDown, ground_m: Height, bounds: Bounds | None = None) -> dict[str, object]:
    """Return the figures of a landing, `beyond` (names of those over their bound) and `soft` (none, and touched).

    `site_good`: slope of the ground under the feet and the highest rock between them are within theirs. Nothing on
    board looks for a good site, so it is no part of `soft`.
    """
    x, y, _ = end.state.position_m.tolist()
    slope_deg, rock_m = map(float, _site(ground_m, x, y))
    bounds = bounds or Bounds()
    figures = {
        "vertical_m_s": end.vertical_m_s,
        "horizontal_m_s": end.horizontal_m_s,
        "tilt_deg": math.degrees(math.acos(min(1.0, float(matrix(end.state.attitude)[2, 2])))),
        "place_m": math.hypot(x, y),
    }
    beyond = [name for name, value in figures.items() if not value < getattr(bounds, name)]
    site = {"slope_deg": slope_deg, "rock_m": rock_m}
    site_good = slope_deg < bounds.slope_deg and rock_m < bounds.rock_m
    return figures | site | {"site_good": bool(site_good), "beyond": beyond, "soft": bool(end.touched and not beyond)}


def _site(ground_m: Height, x_m: float, y_m: float) -> tuple[float, float]:
    """Return the slope of the plane through the ground under four feet, degrees, and the highest ground above it, m."""
    heights = [ground_m(x_m + a * _FEET_M, y_m + b * _FEET_M) for a, b in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    east, north = (heights[0] - heights[2]) / (2 * _FEET_M), (heights[1] - heights[3]) / (2 * _FEET_M)
    middle, over = sum(heights) / 4, 0.0
    for a in np.linspace(-_FEET_M, _FEET_M, _PLACES):
        for b in np.linspace(-_FEET_M, _FEET_M, _PLACES):
            plane = middle + a * east + b * north
            over = max(over, ground_m(x_m + float(a), y_m + float(b)) - plane)
    return math.degrees(math.atan(math.hypot(east, north))), over


class WithoutCamera:
    """Links of a spacecraft whose pilot is in the same program.

    Parameters
    ----------
    pilot : the pilot.
    motion : returns the motion that a camera would have measured with the window of a turn, and its length; for tests.
    """

    def __init__(self, pilot: Pilot, motion: Callable[[float], tuple[Motion, float] | None] = lambda t_s: None) -> None:
        self._pilot, self._motion, self._turn = pilot, motion, 0

    def pose(self, t_s: float, state: State) -> None:
        """Send nothing: no camera."""

    def frame(self, t_s: float, identifier: int, data: bytes) -> None:
        """Give a frame to the pilot."""
        self._pilot.take(identifier, data)

    def sync(self) -> None:
        """Begin the next turn."""
        self._turn += 1

    def trouble(self) -> str:
        """Nothing ends by itself."""
        return ""

    def answer(self, t_s: float, limit_s: float) -> tuple[Vector, int, bytes] | None:
        """Return the pilot's answer, as it would come over the bus."""
        if (seen := self._motion(t_s)) is not None:
            self._pilot.take_motion(*seen)
        command, turn = unpack_command(pack_command(self._pilot.command_m_s2(t_s), self._turn))
        return command, turn, self._pilot.estimate()[1]


def fly_without_camera(
    height_m: float, seed: int, settings: PilotSettings, ground_m: Height, record: Record = lambda t_s, state: None
) -> TouchDown:
    """Return the end of a flight without a camera."""
    mission = Mission.drawn(height_m, seed)
    sensors = Sensors(SensorErrors(), mission.lander, seed, ground_m)
    links = WithoutCamera(Pilot(mission.known, settings))
    return SensingSpacecraft(mission, links, sensors, settings.delay_s).land(ground_m, record)


def main() -> None:
    """Fly many, print a line of JSON for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--height", type=float, default=500.0)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--navigation", nargs="+", default=["blind", "altimeter"])
    arguments = parser.parse_args()
    for navigation in arguments.navigation:
        for seed in range(1, arguments.flights + 1):
            end = fly_without_camera(arguments.height, seed, PilotSettings(navigation), lambda x, y: 0.0)
            row = {"navigation": navigation, "seed": seed, "t_s": end.t_s} | judgement(end, lambda x, y: 0.0)
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
