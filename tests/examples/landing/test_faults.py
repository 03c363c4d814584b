"""Faults outside the camera, and the verdicts on them."""

import dataclasses
import json

import numpy as np
import pytest
from links import Fault, Faults
from report import verdict
from spacecraft import Spacecraft, TouchDown
from vehicle import Lander, State

from firmware_protocol.pose_message import PoseMessage, PoseMessageError

POSE = PoseMessage(8_000_000_000, (1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0), counter=200)
LANDED = TouchDown(30.0, State(np.zeros(3), np.array([0.0, 0.0, -0.5])), touched=True, fuel_kg=5.0)


def test_a_fault_is_read_from_its_text():
    """All of it, or only what must be."""
    assert Fault.parse("lose@0.5+3=0.05") == Fault("lose", 0.5, 3.0, 0.05)
    assert Fault.parse("stop@12") == Fault("stop", 12.0)
    for wrong in ("stop", "stop@", "explode@3", "stop@1+"):
        with pytest.raises(ValueError, match="a fault is"):
            Fault.parse(wrong)


def test_poses_go_wrong_while_the_fault_lasts():
    """Not a number, nothing, or times that run back; sound before and after."""
    assert Faults([Fault("stop", 5.0, 2.0)]).datagram(POSE, 8.0) == bytes(POSE)
    assert Faults([Fault("stop", 7.0, 2.0)]).datagram(POSE, 8.0) is None
    back = Faults([Fault("backwards", 7.0)]).datagram(POSE, 8.0)
    assert PoseMessage.parse(back) == dataclasses.replace(POSE, t_ns=6_000_000_000)
    no_number = Faults([Fault("nan", 7.0)]).datagram(POSE, 8.0)
    assert len(no_number) == len(bytes(POSE))
    with pytest.raises(PoseMessageError, match="finite"):
        PoseMessage.parse(no_number)


def test_frames_are_lost_by_chance_and_by_seed():
    """About their share, the same for one seed, none outside."""
    first, again = (Faults([Fault("lose", 0.0, 10.0, 0.2)], seed=3) for _ in range(2))
    assert [first.loses_frame(1.0) for _ in range(2000)] == [again.loses_frame(1.0) for _ in range(2000)]
    assert 340 < first.frames_lost < 460
    assert not any(first.loses_frame(11.0) for _ in range(100))


class Silent:
    """A connection whose flight computer answers nothing, or whose commands are all lost."""

    def __init__(self, given):
        self.given, self.requests = given, 0

    def pose(self, t_s, state):
        """Send nothing."""

    def frame(self, t_s, identifier, data):
        """Send nothing."""

    def sync(self):
        """Send nothing."""

    def answer(self, t_s, turn, limit_s):
        """Be silent, or lose it."""
        self.requests += 1
        if self.given is TimeoutError:
            raise TimeoutError(f"the flight computer did not answer within {limit_s:g} s")


@pytest.mark.parametrize(("answer", "requests", "sentences"), [(TimeoutError, 1, 1), (None, 63, 0)])
def test_without_commands_the_last_one_holds_to_the_ground(answer, requests, sentences):
    """The vehicle waits once for a silent computer; in each turn for one whose frames are lost."""
    state = State(np.array([0.0, 0.0, 12.0]), np.array([0.0, 0.0, -0.8]), thrust_n=1620.0)
    connection = Silent(answer)
    end = Spacecraft(Lander(), state, connection, answer_s=3.0).land(lambda x, y: 0.0, lambda t_s, state: None)
    assert end.touched
    assert end.vertical_m_s == pytest.approx(0.8, abs=0.02)
    assert len(end.why) == sentences
    assert connection.requests == pytest.approx(requests, abs=2)
    assert all("did not answer within 3 s, at 0.2 s and 11.8 m" in sentence for sentence in end.why)


def test_dynamics_without_numbers_end_the_flight():
    """In lockstep too."""
    state = State(np.array([0.0, 0.0, 12.0]), np.array([0.0, 0.0, np.nan]))
    end = Spacecraft(Lander(), state, Silent(None)).land(lambda x, y: 0.0, lambda t_s, state: None)
    assert (end.touched, end.why) == (False, ("the dynamics gave no numbers at 0.00 s",))


def test_the_verdict_lists_what_went_wrong(tmp_path):
    """Of the flight, the computer and the camera; a landing may be good all the same."""
    row = {"t_s": 1.0, "at_s": 0.9, "down_1_s": 0.08, "gain": float("inf"), "lost": True, "events_lost": 70}
    row["edge"] = False
    (tmp_path / "computer.jsonl").write_text(json.dumps(row))
    (tmp_path / "truth.csv").write_text("t_s,z_m,ground_m,vz_m_s\n0,9,0,-1\n2,8,0,-1\n")
    rule = {"rule": "in real time", "good": False, "told": "worst step 2000 ms late"}
    fault = {"kind": "unplugged", "events_lost": 9, "began_us": 4_000_000}
    summary = {"scene": {"poses refused": 3}, "links": {"events": {"faults": [fault]}}, "rules": [rule]}
    summary |= {"sim_seconds": 2.0, "events": {"read_out": 1_000_000}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    found = verdict(dataclasses.replace(LANDED, why=("a word",)), tmp_path)
    assert found["soft"] is True
    assert found["why"] == [
        "a word",
        "70 events were lost on the serial line",
        "dead reckoning: no motion was seen in 1 of 1 turns",
        "no edge of the SYNC came from the camera in 1 of 1 turns",
        "3 poses were refused: no numbers, or damaged",
        "a storm of events: 500000 a second",
        "fault unplugged on events from 4.0 s on: 9 events lost",
        "the camera's run was not good: in real time: worst step 2000 ms late",
    ]


@pytest.mark.parametrize(("down_m_s", "touched"), [(1.2, True), (0.5, False)])
def test_a_hard_or_missing_touchdown_is_no_landing(down_m_s, touched, tmp_path):
    """Without any files."""
    state = State(np.zeros(3), np.array([0.0, 0.0, -down_m_s]))
    found = verdict(dataclasses.replace(LANDED, state=state, touched=touched), tmp_path)
    assert found["soft"] is False
    assert found["why"] == ["the flight computer answered no SYNC"]
