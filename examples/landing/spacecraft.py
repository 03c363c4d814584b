"""The spacecraft in lockstep: with its own sensors, or with an attitude that the simulation gives; starts by a seed.

Each turn of 0.2 s: the equations are integrated, poses and samples (or attitudes) are sent, then the SYNC lets the
camera's time go on. The command that answers it holds for the next turn, or acts a fixed time after it: computing takes
the same simulated time, however long it takes here. A command that the bus lost leaves the last one in force; so does a
flight computer that has died, and the flight goes on to the ground.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from divergence import Motion
from guidance import Law
from links import Connection
from navigation import Known
from pilot import Pilot, PilotSettings
from sensors import PERIOD_S, SensorErrors, Sensors, pack_command, turn_of, unpack_attitude, unpack_command
from vehicle import GRAVITY_M_S2, NO_TURN, Height, Lander, Record, State, Vector, advance, product

FOOT_M = 2.0  # height of the camera when the feet stand
LEFT_ALONE_S = 60.0  # a flight without commands goes on so long


@dataclass(frozen=True)
class Limits:
    """Wall time within which the flight computer answers, in lockstep; longest flight; s."""

    answer_s: float = 120.0
    longest_s: float = 600.0


USUAL = Limits()


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


def flies(state: State) -> bool:
    """Return True when every value of a state is a number."""
    return bool(np.isfinite(state.packed()).all())


class Spacecraft:
    """One vehicle on one bus, its attitude given: with each picture a pose and an attitude are sent.

    Parameters
    ----------
    lander, state : parameters and start.
    links : to camera and flight computer.
    limits : longest waiting times.
    """

    period_s, periods = 0.04, 5  # of a picture, and so many in a turn

    def __init__(self, lander: Lander, state: State, links: Connection | WithoutCamera, limits: Limits = USUAL) -> None:
        self._lander, self.state, self._links, self._limits = lander, state, links, limits
        self._full_kg = state.mass_kg
        self._number = self._turn = 0
        self._command = np.array([0.0, 0.0, GRAVITY_M_S2])
        self._why: list[str] = []
        self._end_s = limits.longest_s
        self._send()

    @property
    def t_s(self) -> float:
        """Time of the state."""
        return self._number * self.period_s

    def land(self, ground_m: Height, record: Record) -> TouchDown:
        """Fly to the ground, whose height depends on the place; `record` receives time and state of each turn."""
        while self.t_s < self._end_s:
            for _ in range(self.periods):
                state = self._advanced()
                if not flies(state):
                    self._why.append(f"the dynamics gave no numbers at {self.t_s:.2f} s")
                    return self._end(touched=False)
                before, self.state = self.state, state
                self._number += 1
                self._sense(before)
                x, y, z = self.state.position_m.tolist()
                if z - ground_m(x, y) <= FOOT_M:
                    return self._end(touched=True)
                self._send()
            self._turn += 1
            self._links.sync()
            record(self.t_s, self.state)
            self._take_answer()
        self._why.append(f"still flying after {self.t_s:.0f} s")
        return self._end(touched=False)

    def _end(self, *, touched: bool) -> TouchDown:
        return TouchDown(self.t_s, self.state, touched, self._full_kg - self.state.mass_kg, tuple(self._why))

    def _advanced(self) -> State:
        """Return the state a period later."""
        return advance(self._lander, self.state, self._command, self.period_s)

    def _sense(self, before: State) -> None:
        """Sample the period that has passed: no sensors here."""

    def _send(self) -> None:
        """Send pose and attitude of now."""
        self._links.pose(self.t_s, self.state)
        self._links.attitude(self.t_s, self.state, self._number)

    def _answer(self) -> tuple[Vector, int, bytes] | None:
        """Return the next command, its turn, and data that come with it; None when the bus lost it."""
        answer = self._links.command(self.t_s, self._limits.answer_s)
        return None if answer is None else (*answer, b"")

    def _follow(self, command: Vector, estimate: bytes) -> None:
        """Follow a command from now on."""
        self._command = command

    def _take_answer(self) -> None:
        """Take the answer to this turn's SYNC; without one the last command holds."""
        if self._why:
            return
        try:
            while (answer := self._answer()) is not None:
                command, turn, estimate = answer
                if turn == self._turn % (1 << 16):
                    self._follow(command, estimate)
                    return
        except TimeoutError:
            silent = self._links.trouble() or f"the flight computer did not answer within {self._limits.answer_s:g} s"
            self._why.append(f"{silent}, at {self.t_s:.1f} s and {self.state.position_m[2]:.1f} m: no command since")
            self._end_s = min(self.t_s + LEFT_ALONE_S, self._end_s)


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


class SensingSpacecraft(Spacecraft):
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

    period_s, periods = PERIOD_S, 10  # of the IMU, and so many in a turn

    def __init__(
        self,
        mission: Mission,
        links: Connection | WithoutCamera,
        sensors: Sensors,
        delay_s: float = 0.1,
        limits: Limits = USUAL,
    ) -> None:
        self._sensors, self._delay_s = sensors, delay_s
        self._commands: list[tuple[float, Vector]] = [(0.0, np.array([0.0, 0.0, GRAVITY_M_S2]))]
        self._attitude = NO_TURN  # of the attitude control; navigation's at the start
        self._turns: list[Vector] = [NO_TURN]
        super().__init__(mission.lander, mission.state, links, limits)

    def _advanced(self) -> State:
        error = product(self.state.attitude * (1, -1, -1, -1), self._attitude)
        acting = [command for acts_s, command in self._commands if acts_s <= self.t_s + 1e-9][-1]
        return advance(self._lander, self.state, acting, PERIOD_S, error)

    def _sense(self, before: State) -> None:
        """Sample the period, and send the frames that are due, then the pose of each second period."""
        self._turns.append(turn_of(self._sensors.turn_rad(self._number, before, self.state)))
        self._attitude = product(self._attitude, self._turns[-1])
        self._sensors.take(self._number, before, self.state)
        for identifier, data in self._sensors.due(self._number):
            self._links.frame(self.t_s, identifier, data)
        if self._number % 2 == 0:
            self._links.pose(self.t_s, self.state)

    def _send(self) -> None:
        """Send the pose of the start: later ones go with the samples."""
        if self._number == 0:
            self._links.pose(0.0, self.state)

    def _answer(self) -> tuple[Vector, int, bytes] | None:
        return self._links.answer(self.t_s, self._limits.answer_s)

    def _follow(self, command: Vector, estimate: bytes) -> None:
        """Follow a command after the delay, from the estimated attitude, turned by the gyroscope since its time."""
        self._commands = [*self._commands[-3:], (self.t_s + self._delay_s, command)]
        if not estimate:
            return
        q, number = unpack_attitude(estimate)
        for turn in self._turns[self._number - (self._number - number) % (1 << 16) + 1 :]:
            q = product(q, turn)
        self._attitude = q / np.linalg.norm(q)


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
