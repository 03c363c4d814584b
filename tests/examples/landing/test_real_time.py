"""The landing in real time, with clocks and links of its own: nothing here waits, nothing depends on the machine."""

import struct
from collections import deque

import can
import numpy as np
import pytest
from frames import ATTITUDE, COMMAND, EDGE, pack_command, pack_edge, unpack_attitude, unpack_edge
from guidance import Guidance
from links import Faults
from report import latencies
from sensors import STEP_S
from spacecraft import RealTimeSpacecraft
from vehicle import GRAVITY_M_S2, Lander, State


def test_what_is_predicted_is_what_the_commands_sent_do():
    """Two seconds of free motion in closed form; the command of time 0 acts after delay and engine, 0.2 s."""
    guidance = Guidance(100.0, np.array([0.0, 0.0, -5.0]))
    guidance.begin(0.0)
    slowing_m_s2 = guidance.command_m_s2(0.0, 0.0)[2] - GRAVITY_M_S2
    assert abs(slowing_m_s2) > 0.3
    speed_m_s, height_m = 5.0 - slowing_m_s2 * 1.8, 100.0 - 5.0 * 2.0 + slowing_m_s2 * 1.8**2 / 2
    assert guidance.expected(2.0) == pytest.approx(speed_m_s / height_m, rel=0.01)


class Wall:
    """A clock that advances only while a caller waits, and the stream that began at 5 s of it."""

    ORIGIN_NS = 5_000_000_000

    def __init__(self):
        self.ns = 20_000_000_000

    def now_ns(self):
        """The time, ns."""
        return self.ns

    @property
    def stream_s(self):
        """The stream's time."""
        return (self.ns - self.ORIGIN_NS) * 1e-9


class Ends:
    """A connection in the place of the real one: edges come 1 to 4 ms after their SYNC, commands hold the speed."""

    def __init__(self, wall, answers=True):
        self.wall, self.answers, self.ended = wall, answers, ""
        self.frames = deque()
        self.poses = []
        self.stall_s = 0.0
        self.late_ns_more = 0
        self.syncs = 0
        self.faults = Faults()

    def trouble(self):
        """The process that has ended."""
        return self.ended

    def pose(self, t_s, state):
        """Keep a pose with the stream's time at which it was sent."""
        self.poses.append((t_s, self.wall.stream_s, state))

    def frame(self, t_s, identifier, data):
        """Check that the number of an attitude gives the time."""
        assert identifier == ATTITUDE
        assert unpack_attitude(data)[1] * STEP_S == pytest.approx(t_s)

    def sync(self):
        """Answer a SYNC with its edge and a command, a little later."""
        self.syncs = counter = self.syncs % 240 + 1
        late_ns = 1_000_000 * (1 + counter % 4)
        edge_us = (self.wall.ns + late_ns - self.wall.ORIGIN_NS) // 1000
        self.frames.append((self.wall.ns + 2 * late_ns + self.late_ns_more, EDGE, pack_edge(counter, edge_us)))
        if self.answers:
            command = np.array([0.0, 0.0, GRAVITY_M_S2])
            self.frames.append((self.wall.ns + 33_000_000, COMMAND, pack_command(command, counter)))
        return counter

    def receive(self, timeout_s):
        """Return the next frame that is there in time; else let the time pass."""
        end_ns = self.wall.ns + round(timeout_s * 1e9)
        if self.frames and self.frames[0][0] <= end_ns:
            at_ns, identifier, data = self.frames.popleft()
            self.wall.ns = max(self.wall.ns, at_ns)
            return can.Message(arbitration_id=identifier, data=data)
        self.wall.ns = end_ns + round(self.stall_s * 1e9) * (self.stall_s > 0 and len(self.poses) == 600)
        self.stall_s = 0.0 if len(self.poses) == 600 else self.stall_s
        return None


def falling(down_m_s, wall, ends):
    """Return a spacecraft that falls evenly from 12 m."""
    thrust_n = 1000 * GRAVITY_M_S2
    state = State(np.array([0.0, 0.0, 12.0]), np.array([0.0, 0.0, -down_m_s]), thrust_n=thrust_n)
    return RealTimeSpacecraft(Lander(), state, ends, now_ns=wall.now_ns)


def test_dynamics_follow_the_wall_and_poses_bear_the_streams_time():
    """The stream's beginning is found to the least delay; ten metres at 0.8 m/s take 12.5 s of the wall."""
    wall, ends = Wall(), Ends(Wall())
    ends.wall = wall
    spacecraft = falling(0.8, wall, ends)
    end = spacecraft.land(lambda x, y: 0.0, lambda t_s, state: None)
    assert end.touched
    assert end.why == ()
    assert end.vertical_m_s == pytest.approx(0.8, abs=0.02)
    assert end.t_s == pytest.approx(12.5, abs=0.2)
    assert spacecraft.origin_ns - wall.ORIGIN_NS == pytest.approx(-1_000_000, abs=2000)
    late_s = np.array([sent_s - t_s for t_s, sent_s, _ in ends.poses])
    assert np.abs(late_s).max() < 0.002  # sent at its own time
    assert np.diff([t_s for t_s, _, _ in ends.poses]) == pytest.approx(STEP_S, rel=1e-6)
    assert len(spacecraft.commands) > 50
    assert all(0 < shown_ns - received_ns <= 10_000_000 for _, received_ns, shown_ns in spacecraft.commands)


def test_a_machine_that_stands_still_loses_poses_not_time():
    """Half a second passes unseen: the dynamics make up for it, with the newest pose alone."""
    wall, ends = Wall(), Ends(Wall())
    ends.wall, ends.stall_s = wall, 0.5
    spacecraft = falling(0.8, wall, ends)
    end = spacecraft.land(lambda x, y: 0.0, lambda t_s, state: None)
    assert ends.stall_s == 0.0
    assert end.t_s == pytest.approx(12.5, abs=0.2)
    gaps_s = np.diff([t_s for t_s, _, _ in ends.poses])
    assert 0.15 < gaps_s.max() < 0.55  # only those that go with a SYNC were sent
    heights = [(t_s, state.position_m[2]) for t_s, _, state in ends.poses][-300:]
    assert np.diff([h for _, h in heights]) / np.diff([t for t, _ in heights]) == pytest.approx(-0.8, abs=0.02)


def test_a_silent_computer_is_reported_and_the_flight_goes_on():
    """Its last command holds; so does a word of trouble."""
    wall = Wall()
    end = falling(0.8, wall, Ends(wall, answers=False)).land(lambda x, y: 0.0, lambda t_s, state: None)
    assert end.touched
    assert len(end.why) == 1
    assert "has sent nothing for 2." in end.why[0]


def test_the_time_of_an_edge_is_carried():
    """All 48 bits."""
    assert unpack_edge(pack_edge(240, (1 << 48) - 1)) == (240, (1 << 48) - 1)
    with pytest.raises(struct.error, match="8 bytes"):
        unpack_edge(b"abc")
    assert EDGE not in (ATTITUDE, COMMAND)


def test_the_parts_of_the_loop_add_up():
    """A flight whose times are known, with counters that begin anew."""
    origin_ns, rows, commands = 10**12, [], []
    for k in range(300):
        edge_ns = origin_ns + 200_000_000 * k
        times = np.cumsum([edge_ns, 7_000_000, 21_000_000, 300_000, 5_000_000]).tolist()
        row = {"t_s": 0.2 * k, "counter": k % 240 + 1, "window_s": 0.5, "began_ns": times[1], "ended_ns": times[2]}
        rows.append(row | {"arrivals": [[edge_ns, 200_000 * k - 3000, 200_000 * k - 1000, 10]]})
        commands.append((k % 240 + 1, times[3], times[4]))
    found = latencies(origin_ns, commands, rows)
    assert {name: part["median"] for name, part in found["parts_ms"].items()} == {
        "turn begins": 7.0, "estimate": 21.0, "command on bus": 0.3, "shown by a pose": 5.0, "event on the link": 2.0,
    }  # fmt: skip
    assert found["parts_ms"]["estimate"]["n"] == 300
    assert found["window_s"]["median"] == 0.5
