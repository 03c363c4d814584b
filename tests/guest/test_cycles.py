"""Three unmodified drivers open the camera again and again with all streams on, and close it in the midst of them.

A hundred times each:

    EVSTIM_GUEST_CYCLES=100 python -m pytest tests/guest/test_cycles.py
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tests.guest.all_streams import STREAMS
from tests.guest.attachment import Attachment
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig

CYCLES = int(os.environ.get("EVSTIM_GUEST_CYCLES", "3"))
CYCLE_S = 60.0
PROGRAM = str(Path(__file__).parent / "clients" / "cycling.py")

pytestmark = [
    pytest.mark.guest,
    pytest.mark.socket,
    pytest.mark.timeout(CYCLES * CYCLE_S + 900),
]


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_it_is_closed_in_the_midst_of_all_streams_again_and_again(
    guest: Guest, driver: Driver, driver_pythons: dict[str, Path], tmp_path: Path
) -> None:
    argv = [str(driver_pythons[driver.name]), PROGRAM, driver.name, str(CYCLES), str(CYCLE_S)]
    with RunningRig(tmp_path, more=STREAMS) as rig, Attachment(guest, rig.port):
        ended = guest.run(argv, CYCLES * CYCLE_S + 300)
    assert ended.ok, ended
    told = json.loads(ended.stdout.splitlines()[-1])
    assert told["cycles"] == CYCLES
    assert told["files"][0] == told["files"][1]
    assert rig.summary["balanced"], rig.summary
