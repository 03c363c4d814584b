"""Values that a command gives in place of a rig's."""

import pytest

from emulator.rig.loading import parse_rig
from emulator.rig.options import with_options

LOOPING = '[scene]\nkind = "recording"\npath = "r.npz"\n'


def test_a_looping_recording_as_fast_as_possible_needs_an_end():
    rig = parse_rig(LOOPING, "r.toml", "r")
    with pytest.raises(ValueError, match=r"^seconds must be above 0 here, got 0.*scene\.loop"):
        with_options(rig, seconds=0.0, pace="free")
    assert with_options(rig, seconds=1.0, pace="free").run.seconds == 1.0
    assert with_options(rig, seconds=0.0, pace="realtime").run.seconds == 0.0
    once = parse_rig(LOOPING + "loop = false\n", "r.toml", "r")
    assert with_options(once, seconds=0.0, pace="free").run.pace == "free"
