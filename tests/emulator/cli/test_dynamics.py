"""`evstim dynamics`: an FMU's poses arrive as datagrams; errors are told with their exit codes."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_protocol.pose_message import PoseMessage
from tests.emulator.dynamics.conftest import falling
from tests.free_ports import free_port

__all__ = ["falling"]

pytestmark = [pytest.mark.system, pytest.mark.socket]
MAP = 'position_m = [0.0, 0.0, "height_m"]\nstep_s = 0.05\n[file]\npath = "in.csv"\n[start]\nspeed_m_s = -1.0\n'


@pytest.fixture
def dynamics(evstim, tmp_path):
    def run(file, *options, trouble=0):
        (tmp_path / "in.csv").write_text(f"time_s,trouble\n0,0\n0.1,{trouble}\n")
        (tmp_path / "map.toml").write_text(MAP)
        return evstim("dynamics", file, "--map", tmp_path / "map.toml", "--seconds", "0.5", "--json", *options)

    return run


def test_a_fall_arrives(falling, dynamics):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rig:
        rig.bind(("127.0.0.1", 0))
        rig.settimeout(120)
        run = dynamics(falling(2), "--to", f"127.0.0.1:{rig.getsockname()[1]}", "--stamped")
        poses = [PoseMessage.parse(rig.recv(100)) for _ in range(11)]
    assert run.code == 0, run.err
    assert json.loads(run.out.splitlines()[-1])["steps"] == 10
    for k, pose in enumerate(poses):
        t_s = k * 0.05
        assert (pose.t_ns, pose.counter) == (k * 50_000_000, k)
        assert pose.position_m == pytest.approx((0, 0, 100 - t_s - 1.62 * t_s**2 / 2), abs=1e-9)


@pytest.mark.parametrize(("trouble", "told"), [(1, "crashed in its step from 0.1 s"), (2, "height_m = nan")])
def test_a_flight_that_fails(falling, dynamics, trouble, told):
    run = dynamics(falling(3), trouble=trouble)
    assert run.code == 1
    assert told in json.loads(run.out.splitlines()[-1])["error"]


def _told(run):
    """What it said, in one line: long paths break the lines elsewhere."""
    return " ".join(run.err.split())


def test_wrong_use(falling, dynamics, tmp_path):
    run = dynamics(tmp_path / "none.fmu")
    assert (run.code, "no such file" in _told(run)) == (2, True)
    run = dynamics(falling(2), "--to", "10364")
    assert (run.code, "is not HOST:PORT" in _told(run)) == (2, True)


EXAMPLE = Path(__file__).parents[3] / "examples" / "fmu"


@pytest.mark.long
def test_an_fmu_moves_the_camera_of_a_rig(falling, tmp_path):
    """Its fall makes events on a sensor without noise; every pose is taken, and the camera ends where the FMU does."""
    port = free_port()
    rig_file, command = tmp_path / "lander.toml", [sys.executable, "-c", "from emulator.cli import main; main()"]
    rig_file.write_text((EXAMPLE / "lander.toml").read_text().replace("10364", str(port)))
    run = [*command, "run", rig_file, "--json", "--seconds", "0", "--ready-file", tmp_path / "ready"]
    fly = [*command, "dynamics", falling(3), "--map", EXAMPLE / "lander.map.toml", "--seconds", "2"]
    with subprocess.Popen(run, stdout=subprocess.PIPE) as rig:
        try:
            while not (tmp_path / "ready").exists():
                assert rig.poll() is None
            flown = subprocess.run([*fly, "--to", f"127.0.0.1:{port}"], capture_output=True, text=True, timeout=300)
        finally:
            rig.terminate()
        told = json.loads(rig.communicate(timeout=300)[0].splitlines()[-1])
    assert flown.returncode == 0, flown.stderr
    assert "40 steps, 2 s, at the end (0, 0, 85) m" in flown.stdout  # 10 m in the first second, 5 in the next
    assert told["events"]["read_out"] - 20 * told["sim_seconds"] > 500  # a camera that stands gives 17 a second
    poses = told["scene"]
    assert (poses["poses taken"], poses["poses refused"], poses["poses lost"], poses["poses stale"]) == (41, 0, 0, 0)


def lander(folder, name, link='kind = "loopback"'):
    """Write the example's rig with the noise of its camera, whose kernels are prepared, and with another link."""
    text = (EXAMPLE / "lander.toml").read_text()
    for old, new in (("leak_hz = 0.0\nnoise = { rms = 0.0 }\n", ""), ('kind = "loopback"', link)):
        assert text.count(old) == 1
        text = text.replace(old, new)
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def test_in_lockstep_the_same_flight_gives_the_same_events(falling, evstim, tmp_path):
    """Ten metres a second down for a second, then to rest; twice, with a link that delivers to a file."""
    runs = []
    for name in ("first", "again"):
        rig_file = lander(tmp_path, name, f'kind = "file"\npath = "{tmp_path / name}.raw"')
        options = ["--map", EXAMPLE / "lander.map.toml", "--seconds", "2", "--rig", rig_file, "--json"]
        run = evstim("dynamics", falling(3), *options)
        assert run.code == 0, run.err
        runs.append(json.loads(run.out.splitlines()[-1]))
    first, again = (run["run"] for run in runs)
    assert runs[0]["position_m"] == [0.0, 0.0, pytest.approx(85.0)]
    assert first["sim_seconds"] == 2.0
    assert first["events"]["read_out"] > 500
    assert first["events"] == again["events"]
    assert first["links"]["file"]["digest"] == again["links"]["file"]["digest"]
    assert (tmp_path / "first.raw").read_bytes()[-10_000:] == (tmp_path / "again.raw").read_bytes()[-10_000:]


@pytest.mark.parametrize(
    ("trouble", "why", "as_json"), [(1, "crashed", True), (2, "height_m = nan", True), (3, "failed in its step", False)]
)
def test_in_lockstep_the_ledger_is_printed_when_the_fmu_fails(falling, evstim, tmp_path, trouble, why, as_json):
    (tmp_path / "in.csv").write_text(f"time_s,trouble\n0,0\n0.1,{trouble}\n")
    (tmp_path / "map.toml").write_text(MAP)
    options = ["--map", tmp_path / "map.toml", "--seconds", "0.5", "--rig", lander(tmp_path, "rig")]
    run = evstim("dynamics", falling(3), *options, *(["--json"] if as_json else []))
    assert run.code == 1
    assert why in " ".join(run.err.split())
    if as_json:
        printed = json.loads(run.out.splitlines()[-1])
        assert why in printed["error"]
        assert printed["exit_code"] == 1
        assert printed["run"]["sim_seconds"] == pytest.approx(0.1)
        assert {"read_out", "raised"} <= {*printed["run"]["events"]}
        assert "digest" in printed["run"]["links"]["loopback"]
    else:
        assert "ledger: balanced" in run.out
        assert "events: " in run.out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seconds", "0.12"], "--seconds is 0.12: give a multiple of step_s, which is 0.05"),
        (["--seconds", "0.01"], "give a multiple of step_s"),
        (
            ["--seconds", "0.5", "--rig", "eros", "--to", "127.0.0.1:10364"],
            "--to and --stamped have no effect with --rig",
        ),
        (["--seconds", "0.5", "--rig", "eros", "--stamped"], "have no effect with --rig"),
    ],
)
def test_what_would_be_changed_or_have_no_effect_is_refused(evstim, tmp_path, options, message):
    (tmp_path / "map.toml").write_text(MAP)
    run = evstim("dynamics", tmp_path / "none.fmu", "--map", tmp_path / "map.toml", *options)
    assert (run.code, message in _told(run)) == (2, True), run.err


def test_in_lockstep_the_fmu_moves_the_camera_alone(falling, evstim, tmp_path):
    (tmp_path / "map.toml").write_text(
        MAP.replace('[file]\npath = "in.csv"\n', "").replace("step_s", "body = 1\nstep_s")
    )
    options = ["--map", tmp_path / "map.toml", "--seconds", "1", "--rig", EXAMPLE / "lander.toml"]
    run = evstim("dynamics", falling(2), *options)
    assert (run.code, "body = 1: with --rig the FMU moves the camera" in _told(run)) == (2, True)
