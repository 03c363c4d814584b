"""`evstim dynamics`: an FMU's poses arrive as datagrams; errors are told with their exit codes."""

import json
import socket
import subprocess
import sys

import pytest

from firmware_protocol.pose_message import PoseMessage
from tests.emulator.dynamics.conftest import falling

__all__ = ["falling"]

pytestmark = [pytest.mark.system, pytest.mark.socket]
MAP = 'position_m = [0.0, 0.0, "height_m"]\nstep_s = 0.05\n[file]\npath = "in.csv"\n[start]\nspeed_m_s = -1.0\n'


def dynamics(file, folder, *options, trouble=0, seconds=0.5):
    (folder / "in.csv").write_text(f"time_s,trouble\n0,0\n0.1,{trouble}\n")
    (folder / "map.toml").write_text(MAP)
    start = [
        sys.executable,
        "-c",
        "from emulator.cli import main; main()",
        "dynamics",
        file,
        "--map",
        folder / "map.toml",
    ]
    return subprocess.run([*start, "--seconds", str(seconds), "--json", *options], capture_output=True, text=True, timeout=300)


def test_a_fall_arrives(falling, tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rig:
        rig.bind(("127.0.0.1", 0))
        rig.settimeout(10)
        run = dynamics(falling(2), tmp_path, "--to", f"127.0.0.1:{rig.getsockname()[1]}", "--stamped")
        poses = [PoseMessage.parse(rig.recv(100)) for _ in range(11)]
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout.splitlines()[-1])["steps"] == 10
    for k, pose in enumerate(poses):
        t_s = k * 0.05
        assert (pose.t_ns, pose.counter) == (k * 50_000_000, k)
        assert pose.position_m == pytest.approx((0, 0, 100 - t_s - 1.62 * t_s**2 / 2), abs=1e-9)


@pytest.mark.parametrize(("trouble", "told"), [(1, "crashed in its step from 0.1 s"), (2, "height_m = nan")])
def test_a_flight_that_fails(falling, tmp_path, trouble, told):
    run = dynamics(falling(3), tmp_path, trouble=trouble)
    assert (run.returncode, "Traceback" in run.stderr) == (1, False)
    assert told in json.loads(run.stdout.splitlines()[-1])["error"]


def _told(run):
    """What it said, in one line: long paths break the lines elsewhere."""
    return " ".join(run.stderr.split())


def test_wrong_use(falling, tmp_path):
    run = dynamics(tmp_path / "none.fmu", tmp_path)
    assert (run.returncode, "no such file" in _told(run)) == (2, True)
    run = dynamics(falling(2), tmp_path, "--to", "10364")
    assert (run.returncode, "give HOST:PORT" in _told(run)) == (2, True)


RIG = """
[scene]
kind = "terrain"
samples = 1
sun_elevation_deg = 25.0
[scene.camera]
kind = "live"
port = {port}
position_m = [0.0, 0.0, 100.0]
q_world_from_body = [0.0, 1.0, 0.0, 0.0]
[scene.ground]
kind = "ridge"
size_m = 1024.0
finest_m = 1.0
ridge_m = 0.0
seed = 8
[camera.sensor]
width = 64
height = 48
leak_hz = 0.0
[camera.lens]
field_of_view_deg = 60.0
[run]
step_us = 20000
[[links]]
kind = "loopback"
"""


def test_an_fmu_moves_the_camera_of_a_rig(falling, tmp_path):
    """Its fall makes events on a sensor without noise; every pose is taken, and the camera ends where the FMU does."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (tmp_path / "rig.toml").write_text(RIG.format(port=port))
    start = [sys.executable, "-c", "from emulator.cli import main; main()", "run", tmp_path / "rig.toml", "--json"]
    with subprocess.Popen([*start, "--seconds", "0", "--ready-file", tmp_path / "ready"], stdout=subprocess.PIPE) as rig:
        try:
            while not (tmp_path / "ready").exists():
                assert rig.poll() is None
            flown = dynamics(falling(3), tmp_path, "--to", f"127.0.0.1:{port}", seconds=2)
        finally:
            rig.terminate()
        told = json.loads(rig.communicate(timeout=300)[0].splitlines()[-1])
    assert flown.returncode == 0, flown.stderr
    assert told["events"]["read_out"] > 100
    poses = told["scene"]
    assert (poses["poses taken"], poses["poses refused"], poses["poses lost"], poses["poses stale"]) == (41, 0, 0, 0)
