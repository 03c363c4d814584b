"""Inputs of an FMU from a file and from a bus."""

import struct

import can
import pytest

from emulator.dynamics.flight import Bus, DynamicsError, FileInputs, Mapping, Signal, opened_inputs


@pytest.fixture
def csv(tmp_path):
    def write(text):
        (tmp_path / "in.csv").write_text(text)
        return tmp_path / "in.csv"

    return write


def test_a_row_holds_from_its_time_on(csv):
    inputs = FileInputs(csv("time_s,thrust,tilt\n0,1,2\n0.1,3,4\n0.2,5,6\n"))
    assert inputs.names == ("thrust", "tilt")
    given = [inputs.at(t_s) for t_s in (0.0, 0.05, 0.1, 0.9)]
    assert given == [{"thrust": 1, "tilt": 2}, {}, {"thrust": 3, "tilt": 4}, {"thrust": 5, "tilt": 6}]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "line 1 must name the columns"),
        ("time,a\n0,1", "line 1 must name the columns"),
        ("time_s,a\n0,x", "line 2"),
        ("time_s,a\n0,nan", "line 2: expected 2 finite numbers"),
        ("time_s,a\n0,1,2", "line 2: expected 2 finite numbers"),
        ("time_s,a\n1,1\n1,2", "times must ascend"),
    ],
)
def test_files_that_cannot_be_used(csv, text, told):
    with pytest.raises(DynamicsError, match=told):
        FileInputs(csv(text))


def test_the_newest_frame_counts_and_bad_ones_do_not(tmp_path):
    told = Bus("virtual", "evstim-dynamics", (Signal("thrust", 0x120), Signal("tilt", 0x121, ">h", 1, 0.1)))
    mapping = Mapping(position_m=(0.0, 0.0, 0.0), can=told)
    with (
        opened_inputs(mapping, tmp_path) as (inputs,),
        can.Bus(interface="virtual", channel="evstim-dynamics") as other,
    ):
        assert inputs.at(0.0) == {}
        for number, data in (
            (0x120, struct.pack("<f", 1.5)),
            (0x120, struct.pack("<f", 2.5)),
            (0x120, struct.pack("<f", float("nan"))),
            (0x121, b"\x00"),
            (0x121, struct.pack(">xh", -20)),
            (0x7FF, b"\x00" * 8),
        ):
            other.send(can.Message(arbitration_id=number, data=data, is_extended_id=False))
        assert inputs.at(0.1) == {"thrust": 2.5, "tilt": pytest.approx(-2.0)}
        assert inputs.at(0.2) == {}
