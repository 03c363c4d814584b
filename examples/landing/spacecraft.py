"""The spacecraft in lockstep: with its own sensors, or with an attitude that the simulation gives; starts by a seed.

Each turn of 0.2 s: the equations are integrated, poses and samples (or attitudes) are sent, then the SYNC lets the
camera's time go on. The command that answers it acts a fixed time after its turn: computing takes the same simulated
time, however long it takes here. A command that the bus lost leaves the last one in force; so does a flight computer
that has died, and the flight goes on to the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from guidance import wanted_1_s
from links import Connection
from navigation import Known
from pilot import DELAY_S, Pilot
from sensors import (
    ATTITUDE,
    PERIOD_S,
    PICTURE_S,
    SensorErrors,
    Sensors,
    nearest_number,
    pack_attitude,
    pack_command,
    turn_of,
    unpack_attitude,
    unpack_command,
)
from vehicle import GRAVITY_M_S2, NO_TURN, Height, Lander, Record, State, Vector, advance, product

from emulator.geometry.attitude import conjugate

ANSWER_S, LONGEST_S = 120.0, 600.0
_FOOT_M = 2.0  # height of the camera when the feet stand
_LEFT_ALONE_S = 60.0  # a flight without commands goes on so long

# Errors at the start and of the vehicle, 1 sigma, each axis: docs/landing.md.
_HEIGHT_ERROR, _PLACE_ERROR_M, _VELOCITY_ERROR_M_S = 0.05, 5.0, 0.7  # of the state from navigation
_OFFSET_M, _SIDEWAYS_M_S = 10.0, 0.5  # of the true place and speed
_MASS_ERROR, _THRUST_ERROR, _GRAVITY_ERROR_M_S2 = 0.02, 0.015, 0.002


@dataclass(frozen=True)
class TouchDown:
    """End of a flight; `why` lists errors on the way, in words."""

    t_s: float
    state: State
    touched: bool
    fuel_kg: float
    why: tuple[str, ...] = ()

    @property
    def vertical_m_s(self) -> float:
        """Speed into the ground."""
        return -float(self.state.velocity_m_s[2])

    @property
    def horizontal_m_s(self) -> float:
        """Speed along the ground."""
        return float(np.hypot(*self.state.velocity_m_s[:2]))


@dataclass(frozen=True)
class Mission:
    """A start: the true state and vehicle, and the state from navigation."""

    state: State
    lander: Lander
    known: Known

    @classmethod
    def drawn(cls, height_m: float, seed: int) -> Mission:
        """Return the start of a seed with the vehicle's own sensors; the height is above the site."""
        draw = np.random.default_rng([seed, 28])
        down = wanted_1_s(height_m) * height_m * draw.uniform(0.9, 1.1)
        velocity = np.array([*draw.normal(0, _SIDEWAYS_M_S, 2), -down])
        place = np.array([*draw.normal(0, _OFFSET_M, 2), height_m])
        mass_kg = float(draw.uniform(900, 1100))
        gravity = np.array([0.0, 0.0, -GRAVITY_M_S2]) + draw.normal(0, _GRAVITY_ERROR_M_S2, 3)
        lander = Lander(
            thrust_scale=float(1 + draw.normal(0, _THRUST_ERROR)),
            mass_error_kg=float(mass_kg * draw.normal(0, _MASS_ERROR)),
            gravity_m_s2=tuple(gravity.tolist()),
        )
        known_place = place + (*draw.normal(0, _PLACE_ERROR_M, 2), height_m * draw.normal(0, _HEIGHT_ERROR))
        known_velocity = velocity + draw.normal(0, _VELOCITY_ERROR_M_S, 3)
        sigmas = _PLACE_ERROR_M, _HEIGHT_ERROR * height_m, _VELOCITY_ERROR_M_S
        known = Known(tuple(known_place.tolist()), tuple(known_velocity.tolist()), *sigmas)
        return cls(State(place, velocity, mass_kg=mass_kg, thrust_n=mass_kg * GRAVITY_M_S2), lander, known)

    @classmethod
    def with_given_attitude(cls, height_m: float, seed: int) -> Mission:
        """Return the start of a seed with a given attitude; the height is above the ground at the origin."""
        draw = np.random.default_rng(seed)
        down = wanted_1_s(height_m) * height_m * draw.uniform(0.9, 1.1)
        velocity = np.array([*draw.normal(0, 0.0004 * height_m, 2), -down])
        mass_kg = draw.uniform(900, 1100)
        lander = Lander(thrust_scale=draw.uniform(0.97, 1.03))
        place = np.array([*draw.uniform(-5, 5, 2), height_m])
        known_velocity = velocity * draw.uniform(0.95, 1.05)
        known = Known((0.0, 0.0, height_m * draw.uniform(0.9, 1.1)), tuple(known_velocity.tolist()))
        return cls(State(place, velocity, mass_kg=mass_kg, thrust_n=mass_kg * GRAVITY_M_S2), lander, known)


class Spacecraft:
    """One vehicle on one bus.

    Without sensors a pose and an attitude are sent with each picture, and a command acts at once. With sensors nothing
    but their samples is sent, a command acts `delay_s` after its turn, and attitude control turns by the gyroscope from
    the flight computer's newest estimate on.

    Parameters
    ----------
    lander, state : parameters and start.
    links : to camera and flight computer.
    sensors : of the vehicle.
    delay_s : from the end of a turn until its command acts.
    answer_s, longest_s : wall time within which the flight computer answers, in lockstep; longest flight.
    """

    def __init__(
        self,
        lander: Lander,
        state: State,
        links: Connection | WithoutCamera,
        sensors: Sensors | None = None,
        delay_s: float = DELAY_S,
        answer_s: float = ANSWER_S,
        longest_s: float = LONGEST_S,
    ) -> None:
        self._lander, self.state, self._links = lander, state, links
        self._sensors, self._delay_s, self._answer_s = sensors, delay_s if sensors else 0.0, answer_s
        self._period_s, self._periods = (PERIOD_S, 10) if sensors else (PICTURE_S, 5)  # so many in a turn
        self._full_kg = state.mass_kg
        self._number = self._turn = 0
        self._commands = [(0.0, np.array([0.0, 0.0, GRAVITY_M_S2]))]
        self._attitude = NO_TURN  # of the attitude control with sensors; navigation's at the start
        self._turns: list[Vector] = [NO_TURN]
        self._why: list[str] = []
        self._start_s, self._end_s = 0.0, longest_s

    @property
    def t_s(self) -> float:
        """Time of the state."""
        return self._number * self._period_s

    def land(self, ground_m: Height, record: Record) -> TouchDown:
        """Fly to the ground, whose height depends on the place; `record` receives time and state of each turn."""
        touched = self._begins() and self._touches(ground_m, record)
        fuel_kg = self._full_kg - self.state.mass_kg
        return TouchDown(self.t_s - self._start_s, self.state, touched, fuel_kg, tuple(self._why))

    def _begins(self) -> bool:
        """Send the start; return whether the descent begins."""
        self._links.pose(0.0, self.state)
        if self._sensors is None:
            self._links.frame(0.0, ATTITUDE, pack_attitude(self.state.attitude, 0))
        return True

    def _touches(self, ground_m: Height, record: Record) -> bool:
        """Fly on; return whether that ends on the ground."""
        while self.t_s < self._end_s:
            for _ in range(self._periods):
                state = self._advanced()
                if not np.isfinite(state.packed()).all():
                    self._why.append(f"the dynamics gave no numbers at {self.t_s:.2f} s")
                    return False
                before, self.state = self.state, state
                self._number += 1
                x, y, z = self.state.position_m.tolist()
                if z - ground_m(x, y) <= _FOOT_M:
                    return True
                self._send(before)
            self._turn += 1
            self._links.sync()
            record(self.t_s, self.state)
            self._take_answer()
        self._why.append(f"still flying after {self.t_s - self._start_s:.0f} s")
        return False

    def _advanced(self) -> State:
        """Return the state a period later."""
        error = product(conjugate(self.state.attitude), self._attitude) if self._sensors else NO_TURN
        acting = [command for acts_s, command in self._commands if acts_s <= self.t_s + 1e-9][-1]
        return advance(self._lander, self.state, acting, self._period_s, error)

    def _send(self, before: State) -> None:
        """Send what belongs to the end of a period: pose and attitude; or samples, and each second time the pose."""
        if self._sensors is None:
            self._links.pose(self.t_s, self.state)
            self._links.frame(self.t_s, ATTITUDE, pack_attitude(self.state.attitude, self._number))
            return
        self._turns.append(turn_of(self._sensors.turn_rad(self._number, before, self.state)))
        self._attitude = product(self._attitude, self._turns[-1])
        for identifier, data in self._sensors.frames(self._number, before, self.state):
            self._links.frame(self.t_s, identifier, data)
        if self._number % 2 == 0:
            self._links.pose(self.t_s, self.state)

    def _take_answer(self) -> None:
        """Take the answer to this turn's SYNC; without one the last command holds."""
        if self._why:
            return
        try:
            answer = self._links.answer(self.t_s, self._turn, self._answer_s)
        except TimeoutError as error:
            self._goes_alone(str(error))
            return
        if answer is None:
            return
        command, estimate = answer
        self._commands = [*self._commands[-3:], (self.t_s + self._delay_s, command)]
        if estimate:  # the attitude control starts anew from it, turned by the gyroscope since its time
            q, number = unpack_attitude(estimate)
            for turn in self._turns[nearest_number(number, self._number) + 1 :]:
                q = product(q, turn)
            self._attitude = q / np.linalg.norm(q)

    def _goes_alone(self, cause: str) -> None:
        """Record that commands no longer come; the last one holds."""
        t_s, height_m = self.t_s - self._start_s, self.state.position_m[2]
        self._why.append(f"{cause}, at {t_s:.1f} s and {height_m:.1f} m: no command since")
        self._end_s = min(self.t_s + _LEFT_ALONE_S, self._end_s)


class WithoutCamera:
    """Links of a spacecraft whose pilot is in the same program; poses and SYNCs go nowhere."""

    def __init__(self, pilot: Pilot) -> None:
        self._pilot = pilot

    def pose(self, t_s: float, state: State) -> None:
        """Send nothing: no camera."""

    def frame(self, t_s: float, identifier: int, data: bytes) -> None:
        """Give a frame to the pilot."""
        self._pilot.take_frame(identifier, data)

    def sync(self) -> None:
        """Send nothing: no camera."""

    def answer(self, t_s: float, turn: int, limit_s: float) -> tuple[Vector, bytes]:
        """Return the pilot's answer, as it would come over the bus."""
        command, _ = unpack_command(pack_command(self._pilot.command_m_s2(t_s, 0.0), turn))
        return command, self._pilot.estimate()


def fly_without_camera(
    height_m: float, seed: int, navigation: str, ground_m: Height, delay_s: float = DELAY_S
) -> TouchDown:
    """Return the end of a flight without a camera."""
    mission = Mission.drawn(height_m, seed)
    sensors = Sensors(SensorErrors(), mission.lander, seed, ground_m)
    links = WithoutCamera(Pilot(mission.known, navigation, delay_s=delay_s))
    spacecraft = Spacecraft(mission.lander, mission.state, links, sensors=sensors, delay_s=delay_s)
    return spacecraft.land(ground_m, lambda t_s, state: None)
