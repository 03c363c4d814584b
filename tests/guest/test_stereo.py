"""iniVation's libraries bring the two cameras of a stereo rig to one clock by themselves, and read both exactly.

dv-processing 1.7.9 has `StereoCapture` for that, 2.0.4 `synchronizeAnyTwo`; both ask the cameras which one is the
master, and wait until a reset has come from both.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.guest.attachment import Attachment
from tests.guest.comparison import assert_same, load_seen
from tests.guest.environments import DRIVERS, Driver
from tests.guest.machine import Guest
from tests.guest.running_rig import Delivered, RunningRig, free_port
from tests.guest.streaming import Streaming

EVENTS = 50_000  # of each camera: half a second of device time
TIMEOUT_S = 240.0
RIG = Path(__file__).parents[2] / "rigs" / "stars-stereo.toml"

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(TIMEOUT_S + 900)]


def shipped(right_port: int) -> str:
    """Return the shipped rig with ports of its own, as `RunningRig` fills it in."""
    text = RIG.read_text().replace("{", "{{").replace("}", "}}")
    return text.replace('name = "left"', 'name = "left"\nport = {port}').replace("port = 3241", f"port = {right_port}")


@pytest.mark.parametrize("driver", DRIVERS[:2], ids=lambda driver: driver.name)
def test_a_library_brings_both_cameras_to_one_clock(
    guest: Guest, driver: Driver, driver_pythons: dict[str, Path], tmp_path: Path
) -> None:
    client, right_port = replace(driver, name=f"stereo_{driver.name}"), free_port()
    with (
        RunningRig(tmp_path, text=shipped(right_port)) as rig,
        Attachment(guest, rig.port),
        Attachment(guest, right_port, beside=1),
    ):
        seen = Streaming(guest, client, driver_pythons[driver.name], EVENTS, timeout_s=TIMEOUT_S).wait()
    assert seen.about["running"] == [True, True]
    offsets_us = []
    for name, events in (("left", seen.events), ("right", load_seen(guest.results / f"{client.name}-right.npz"))):
        delivered = Delivered.load(tmp_path / f"delivered-{name}.npz").turns[-1].events
        offsets_us.append(int(events["t"][0]) - int(delivered["t"][0]))
        assert len(events) >= EVENTS
        assert_same(events, delivered, offset_us=offsets_us[-1])
    assert offsets_us[0] == offsets_us[1]
    assert rig.summary["balanced"], rig.summary
