"""Values that a command gives in place of a rig's."""

import re

import numpy as np
import pytest

from emulator.rig.loading import parse_rig, with_options

LOOPING = '[scene]\nkind = "recording"\npath = "r.npz"\n'


def test_a_looping_recording_as_fast_as_possible_needs_an_end():
    rig = parse_rig(LOOPING, "r.toml", "r")
    with pytest.raises(ValueError, match=r"^seconds must be above 0 here, got 0.*scene\.loop"):
        with_options(rig, seconds=0.0, pace="free")
    assert with_options(rig, seconds=1.0, pace="free").run.seconds == 1.0
    assert with_options(rig, seconds=0.0, pace="realtime").run.seconds == 0.0
    once = parse_rig(LOOPING + "loop = false\n", "r.toml", "r")
    assert with_options(once, seconds=0.0, pace="free").run.pace == "free"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": "a"}, "seed must be a whole number, got 'a'"),
        ({"seed": 1.5}, "seed must be a whole number, got 1.5"),
        ({"seed": -1}, "seed must be 0 to 9223372036854775807, got -1"),
        ({"seconds": "1"}, "seconds must be a number, got '1'"),
        ({"seconds": -1}, "seconds must be 0 to 32000000, got -1.0"),
        ({"pace": "fast"}, "pace 'fast' is not known here; known are realtime, free, lockstep"),
    ],
)
def test_an_option_that_does_not_fit_is_named(options, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        with_options(parse_rig('[scene]\nkind = "checkerboard"\n', "r.toml", "r"), **options)


def test_numbers_of_numpy_are_numbers():
    rig = parse_rig('[scene]\nkind = "checkerboard"\n', "r.toml", "r")
    assert with_options(rig, np.float32(0.5), np.uint8(7)).run.seed == 7
