"""The mapping file: what it reads, and what it says of a mistake."""

import pytest

from emulator.dynamics.flight import DynamicsError, Signal, load_mapping

WHOLE = """
position_m = [0.0, "y", "height_m"]
q_world_from_body = [0.0, 1.0, 0.0, 0.0]
step_s = 0.02
[start]
mass_kg = 3.0
[file]
path = "commands.csv"
[can]
interface = "virtual"
channel = "a"
[[can.signals]]
variable = "thrust"
id = 0x120
format = ">h"
at = 2
scale = 0.5
offset = -1.0
"""


@pytest.fixture
def load(tmp_path):
    def load(text):
        (tmp_path / "map.toml").write_text(text)
        return load_mapping(tmp_path / "map.toml")

    return load


def test_a_whole_file(load):
    mapping = load(WHOLE)
    assert mapping.outputs == ("y", "height_m")
    assert (mapping.step_s, mapping.body, mapping.start, mapping.file.path) == (
        0.02,
        0,
        {"mass_kg": 3.0},
        "commands.csv",
    )
    assert mapping.can.signals[0].value(bytes([9, 9, 0xFF, 0xFE])) == -2.0
    assert mapping.can.signals[0].value(bytes([9, 9, 0xFF])) is None


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("position = [1, 2, 3]", "did you mean 'position_m'"),
        ('position_m = ["x", "y"]', "position_m"),
        ("step_s = 1", "'position_m' is missing"),
        ("position_m = [0, 0, 0]\nstep_s = 0", "step_s must be 1e-05 to 10"),
        ("position_m = [0, 0, 0]\nbody = -1", "body must be 0 to 65535"),
        ("position_m = [", "not valid TOML"),
    ],
)
def test_mistakes(load, text, told):
    with pytest.raises(DynamicsError, match=told):
        load(text)


@pytest.mark.parametrize(("format", "told"), [("<hh", "one number"), ("4s", "one number"), ("!?!", "format")])
def test_formats_that_read_no_number(format, told):
    with pytest.raises(ValueError, match=told):
        Signal("a", 1, format)


def test_no_file(tmp_path):
    with pytest.raises(DynamicsError, match="cannot be read"):
        load_mapping(tmp_path / "none.toml")
