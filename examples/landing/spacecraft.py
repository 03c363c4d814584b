"""The spacecraft: with its own sensors, or with an attitude that the simulation gives; starts by a seed.

In lockstep, each turn of 0.2 s: the equations are integrated, poses and samples (or attitudes) are sent, then the SYNC
lets the camera's time go on. The command that answers it acts a fixed time after its turn: computing takes the same
simulated time, however long it takes here. A command that the bus lost leaves the last one in force; so does a flight
computer that has died, and the flight goes on to the ground.

In real time the dynamics are integrated by the wall clock, and no process waits for another. First SYNCs go out, and
the flight computer sends the time of each one's edge among the events. The least delay of them gives the wall time at
which the camera's stream began. Then, every 10 ms, the equations go on by 10 ms; pose and attitude leave with their own
time, each 0.2 s a SYNC. A command holds from the next step after it came until the next one comes. A late machine
integrates the missed time, and sends the newest pose alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import frames
import numpy as np
from guidance import wanted_1_s
from links import Connection
from navigation import Known
from pilot import DELAY_S, Pilot
from sensors import PERIOD_S, PICTURE_S, STEP_S, SensorErrors, Sensors, turn_of
from vehicle import GRAVITY_M_S2, NO_TURN, Height, Lander, State, Vector, advance, product

from emulator.geometry.attitude import conjugate

ANSWER_S, LONGEST_S = 120.0, 600.0
_FOOT_M = 2.0  # height of the camera when the feet stand
_LEFT_ALONE_S = 60.0  # a flight without commands goes on so long
_STEPS_A_TURN = 20
_SYNCS, _SYNC_NS, _LONGEST_SYNCHRONISING_NS = 20, 100_000_000, 60_000_000_000
_STANDING_STEPS = 100  # the camera's change to the start makes events that show no motion
_SILENT_S = 2.0
_LATE_NS = 1_000_000_000  # for an edge: a camera that is later does not keep up
_NO_CAMERA = "the descent did not begin: the camera is silent, or more than half a second late"

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


@dataclass
class Spacecraft:
    """One vehicle on one bus, in lockstep.

    Without sensors a pose and an attitude are sent with each picture, and a command acts at once. With sensors nothing
    but their samples is sent, a command acts DELAY_S after its turn, and attitude control turns by the gyroscope from
    the flight computer's newest estimate on.
    """

    lander: Lander
    state: State
    links: Connection | WithoutCamera  # to camera and flight computer
    sensors: Sensors | None = None
    longest_s: float = LONGEST_S  # of the flight
    answer_s: float = ANSWER_S  # wall time within which the flight computer answers, in lockstep

    def __post_init__(self) -> None:
        self._period_s, self._periods = (PERIOD_S, 10) if self.sensors else (PICTURE_S, 5)  # so many in a turn
        self._full_kg = self.state.mass_kg
        self._number = self._turn = 0
        self._commands = [(0.0, np.array([0.0, 0.0, GRAVITY_M_S2]))]
        self._attitude = NO_TURN  # of the attitude control with sensors; navigation's at the start
        self._turns: list[Vector] = [NO_TURN]
        self._why: list[str] = []
        self._start_s, self._end_s = 0.0, self.longest_s

    @property
    def t_s(self) -> float:
        """Time of the state."""
        return self._number * self._period_s

    def land(self, ground_m: Height, record: Callable[[float, State], None]) -> TouchDown:
        """Fly to the ground, whose height depends on the place; `record` receives time and state of each turn."""
        touched = self._begins() and self._touches(ground_m, record)
        fuel_kg = self._full_kg - self.state.mass_kg
        return TouchDown(self.t_s - self._start_s, self.state, touched, fuel_kg, tuple(self._why))

    def _begins(self) -> bool:
        """Send the start; return whether the descent begins."""
        self.links.pose(0.0, self.state)
        if self.sensors is None:
            self.links.frame(0.0, frames.ATTITUDE, frames.pack_attitude(self.state.attitude, 0))
        return True

    def _touches(self, ground_m: Height, record: Callable[[float, State], None]) -> bool:
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
            self.links.sync()
            record(self.t_s, self.state)
            self._take_answer()
        self._why.append(f"still flying after {self.t_s - self._start_s:.0f} s")
        return False

    def _advanced(self) -> State:
        """Return the state a period later."""
        error = product(conjugate(self.state.attitude), self._attitude) if self.sensors else NO_TURN
        acting = [command for acts_s, command in self._commands if acts_s <= self.t_s + 1e-9][-1]
        return advance(self.lander, self.state, acting, self._period_s, error)

    def _send(self, before: State) -> None:
        """Send what belongs to the end of a period: pose and attitude; or samples, and each second time the pose."""
        if self.sensors is None:
            self.links.pose(self.t_s, self.state)
            self.links.frame(self.t_s, frames.ATTITUDE, frames.pack_attitude(self.state.attitude, self._number))
            return
        self._turns.append(turn_of(self.sensors.turn_rad(self._number, before, self.state)))
        self._attitude = product(self._attitude, self._turns[-1])
        for identifier, data in self.sensors.frames(self._number, before, self.state):
            self.links.frame(self.t_s, identifier, data)
        if self._number % 2 == 0:
            self.links.pose(self.t_s, self.state)

    def _take_answer(self) -> None:
        """Take the answer to this turn's SYNC; without one the last command holds."""
        if self._why:
            return
        try:
            answer = self.links.answer(self.t_s, self._turn, self.answer_s)
        except TimeoutError as error:
            self._goes_alone(str(error))
            return
        if answer is None:
            return
        command, estimate = answer
        self._commands = [*self._commands[-3:], (self.t_s + (DELAY_S if self.sensors else 0.0), command)]
        if estimate:  # the attitude control starts anew from it, turned by the gyroscope since its time
            q, number = frames.unpack_attitude(estimate)
            for turn in self._turns[frames.nearest_number(number, self._number) + 1 :]:
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
        command, _ = frames.unpack_command(frames.pack_command(self._pilot.command_m_s2(t_s, 0.0), turn))
        return command, self._pilot.estimate()


def fly_without_camera(height_m: float, seed: int, navigation: str, ground_m: Height) -> TouchDown:
    """Return the end of a flight without a camera."""
    mission = Mission.drawn(height_m, seed)
    unit, links = (
        Sensors(SensorErrors(), mission.lander, seed, ground_m),
        WithoutCamera(Pilot(mission.known, navigation)),
    )
    return Spacecraft(mission.lander, mission.state, links, unit).land(ground_m, lambda t_s, state: None)


@dataclass
class RealTimeSpacecraft(Spacecraft):
    """One vehicle in real time, its attitude given.

    `origin_ns` is the instant at which the stream began, CLOCK_MONOTONIC. `commands` has, of each command, the counter
    of the SYNC that it answers, and the instants when it came and when a pose showed it.
    """

    now_ns: Callable[[], int] = time.monotonic_ns

    def __post_init__(self) -> None:
        super().__post_init__()
        self._period_s, self._periods = STEP_S, _STEPS_A_TURN
        self._received: list[tuple[int, int]] = []  # counter and time of commands that no pose has shown yet
        self._received_ns = self.origin_ns = 0
        self.commands: list[tuple[int, int, int]] = []

    def _begins(self) -> bool:
        """Find when the stream began, and show the start to the camera; return whether it is in time."""
        if not self._synchronise():
            self._why.append(self.links.trouble() or _NO_CAMERA)
            return False
        for _ in range(_STANDING_STEPS):
            self._receive(self._due_ns(self._number + 1))
            self._number += 1
            self.links.pose(self.t_s, self.state)
        self._start_s, self._received_ns = self.t_s, self.now_ns()
        self._end_s += self.t_s
        return True

    def _synchronise(self) -> bool:
        """Find when the stream began; False when no edges come."""
        sent: dict[int, int] = {}
        origins: list[int] = []
        end_ns = self.now_ns() + _LONGEST_SYNCHRONISING_NS
        while len(origins) < _SYNCS and self.now_ns() < end_ns and not self.links.trouble():
            counter, sent_ns = self.links.sync(), self.now_ns()
            sent[counter] = sent_ns
            while (left_ns := sent_ns + _SYNC_NS - self.now_ns()) > 0:
                message = self.links.receive(left_ns * 1e-9)
                if message is not None and message.arbitration_id == frames.EDGE:
                    counter, t_us = frames.unpack_edge(bytes(message.data))
                    if counter in sent and self.now_ns() - sent[counter] < _LATE_NS:
                        origins.append(sent[counter] - t_us * 1000)
        if len(origins) < _SYNCS:
            return False
        self.origin_ns = max(origins)  # an edge comes after its SYNC: the least delay is the best
        turns = round((self.now_ns() - self.origin_ns) * 1e-9 / STEP_S / _STEPS_A_TURN)
        self._number = turns * _STEPS_A_TURN
        return True

    def _due_ns(self, number: int) -> int:
        """Return the instant of a step."""
        return self.origin_ns + round(number * STEP_S * 1e9)

    def _advanced(self) -> State:
        """Read commands until the next step is due; return the state at it."""
        self._receive(self._due_ns(self._number + 1))
        return super()._advanced()

    def _receive(self, due_ns: int) -> None:
        """Take commands until an instant, and those that have come already in any case."""
        while True:
            left_ns = due_ns - self.now_ns()
            message = self.links.receive(max(left_ns, 0) * 1e-9)
            is_command = message is not None and message.arbitration_id == frames.COMMAND
            if is_command and not self.links.faults.loses_frame(self.t_s):
                command, counter = frames.unpack_command(bytes(message.data))
                self._commands = [(0.0, command)]
                self._received_ns = self.now_ns()
                self._received.append((counter, self._received_ns))
            elif message is None and left_ns <= 0:
                return

    def _send(self, before: State) -> None:
        """Send pose and attitude, unless a newer one is due already."""
        if self.now_ns() >= self._due_ns(self._number + 1) and self._number % _STEPS_A_TURN:
            return
        super()._send(before)
        now_ns = self.now_ns()
        self.commands += [(*received, now_ns) for received in self._received]
        self._received = []

    def _take_answer(self) -> None:
        """Record once that commands no longer come: they are taken as they come."""
        silent_s = (self.now_ns() - self._received_ns) * 1e-9
        trouble = self.links.trouble()
        if not self._why and (trouble or silent_s > _SILENT_S):
            self._goes_alone(trouble or f"the flight computer has sent nothing for {silent_s:.1f} s")
