"""Renderers of others feed an unmodified driver: MuJoCo and Mitsuba draw, dv-processing reads every event.

Each renderer has an environment of its own, as a user would have, and of evstim only the file evstim/renderer.py.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.firmware_protocol.ground.own_environments import python_with
from tests.free_ports import free_port
from tests.guest.attachment import Attachment
from tests.guest.environments import DRIVERS
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig
from tests.guest.streaming import Streaming
from tests.guest.test_drivers import assert_sees, since_last_reset

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "renderers"
EVENTS = 15_000
TIMEOUT_S = 600.0  # a light frame of Mitsuba takes seconds on a busy machine

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1800)]


@contextmanager
def drawing(python: Path, program: str, port: int) -> Iterator[None]:
    """Run an example beside the block; it connects as soon as evstim listens."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    with subprocess.Popen([python, EXAMPLES / program, f"127.0.0.1:{port}"], env=environment) as process:
        try:
            yield
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("rig", "program", "package"),
    [
        ("tumbling.toml", "tumbling_mujoco.py", "mujoco>=3.2,<4 numpy"),
        ("orbit.toml", "orbit_mitsuba.py", "mitsuba>=3.5,<4 numpy"),
    ],
)
def test_a_driver_reads_every_event_of_a_renderer(
    guest: Guest, driver_pythons: dict[str, Path], tmp_path: Path, rig: str, program: str, package: str
) -> None:
    variable = f"EVSTIM_{package.split('>')[0].upper()}_PYTHON"
    python = python_with(package, variable, tmp_path / "venv")
    driver, scene_port = DRIVERS[0], free_port()
    text = (EXAMPLES / rig).read_text().replace("port = 5560", f"port = {scene_port}") + "port = {port}\n"
    with drawing(python, program, scene_port), RunningRig(tmp_path, text=text) as run, Attachment(guest, run.port):
        streaming = Streaming(guest, driver, driver_pythons[driver.name], EVENTS, timeout_s=TIMEOUT_S)
        seen = streaming.wait()
    assert len(seen.events) >= EVENTS
    assert_sees(driver, seen.events, since_last_reset(run.delivered))
    assert run.summary["balanced"], run.summary
    assert run.summary["scene"]["images"] > 1, run.summary
