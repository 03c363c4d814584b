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
from tests.guest.machine import Finished, Guest
from tests.guest.running_rig import RunningRig
from tests.guest.turns import Turns, selected

CYCLES = int(os.environ.get("EVSTIM_GUEST_CYCLES", "3"))
CYCLE_S = 60.0
PROGRAM = str(Path(__file__).parent / "clients" / "cycling.py")

pytestmark = [
    pytest.mark.guest,
    pytest.mark.socket,
    pytest.mark.timeout(3 * (CYCLES * CYCLE_S + 900)),  # the first test waits for all drivers
]


@pytest.fixture(scope="module")
def cycled(
    request: pytest.FixtureRequest,
    guest: Guest,
    driver_pythons: dict[str, Path],
    tmp_path_factory: pytest.TempPathFactory,
) -> Turns[Driver, Finished]:
    rig = RunningRig(tmp_path_factory.mktemp("cycles"), more=STREAMS)

    def cycle(driver: Driver) -> Finished:
        python = driver_pythons[driver.name]
        guest.prepare(python, driver.imports)
        with Attachment(guest, rig.port):
            return guest.run([str(python), PROGRAM, driver.name, str(CYCLES), str(CYCLE_S)], CYCLES * CYCLE_S + 300)

    return Turns(rig, selected(request, "driver"), cycle)


@pytest.mark.shows("davis346", "{driver.name}", "cycles")
@pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.name)
def test_it_is_closed_in_the_midst_of_all_streams_again_and_again(
    cycled: Turns[Driver, Finished], driver: Driver
) -> None:
    ended = cycled.result(driver)
    assert ended.ok, ended
    told = json.loads(ended.stdout.splitlines()[-1])
    assert told["cycles"] == CYCLES
    assert told["files"][0] == told["files"][1]
    assert cycled.rig.summary["balanced"], cycled.rig.summary
