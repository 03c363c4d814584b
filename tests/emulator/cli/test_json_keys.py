"""Keys of `evstim run --json` that have a new name: the old one stays for one version, with the same value."""

import pytest

from emulator.cli.run import summary
from emulator.rig.loading import load_rig
from emulator.run.outcome import Ledger, RunResult
from emulator.run.pacing import Lateness


@pytest.mark.parametrize("share", [0.25, 0.0, None])
def test_the_share_of_undersampled_steps_has_both_keys(share):
    result = RunResult(1.0, 1.0, 3, 2, Ledger(0, 0, 0, 0), Lateness(), undersampled_share=share)
    told = summary(load_rig("checkerboard"), result)
    assert told["undersampled_share"] == told["suspect_share"] == share
