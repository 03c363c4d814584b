"""The whole chain: scene, sensor, instrument, serial line, and the decoder on a microcontroller at its other end."""

import json
import os
import subprocess
import sys

import pytest

from tests.firmware_protocol.c.board import Board, build_firmware

pytestmark = [pytest.mark.arm, pytest.mark.socket, pytest.mark.timeout(900)]

RIG = """
[scene]
kind = "checkerboard"
square_px = 40.0
speed_px_s = {speed_px_s}
direction_deg = 30.0
bright = 1.0
dark = 0.25
[camera]
model = "davis346"
[run]
step_us = 1000
max_late_ms = 0
seed = 1
[[links]]
kind = "serial"
port = "socket://127.0.0.1:{port}"
baud = 115200
profile = "{profile}"
"""


def evstim_run(rig):
    program = [sys.executable, "-c", "from emulator.cli import main; main()"]
    command = [*program, "run", str(rig), "--seconds", "1", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=800, env={**os.environ, "NO_COLOR": "1"})
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    ("letter", "profile", "speed_px_s"),
    [("c", "ccsds-cobs", 0.2), ("s", "ccsds-slip", 1.0)],
    ids=["cobs, all fits", "slip, too much for the line"],
)
def test_the_microcontroller_gets_what_was_sent(tmp_path, letter, profile, speed_px_s):
    board = Board(build_firmware(tmp_path))
    try:
        board.ask(letter)
        rig = tmp_path / "microcontroller.toml"
        rig.write_text(RIG.format(port=board.port, profile=profile, speed_px_s=speed_px_s))
        summary = evstim_run(rig)
        sent = summary["events"]["links"]["serial"]["delivered"]
        told = board.wait("events", sent)
        assert sent > 1000
        assert (told["events"], told["digest"]) == (sent, summary["links"]["serial"]["digest"])
        assert (told["missing"], told["errors"]) == (0, 0)
        assert 0 <= told["dropped"] <= summary["events"]["dropped_in_device"]
    finally:
        board.close()
