"""`evstim vizard` as a process, with ZeroMQ's own socket in the place of Basilisk."""

import json
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import zmq
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2] / "firmware_protocol" / "vizard"))

from wire_writer import update

from emulator.cli.output import Failure
from emulator.cli.vizard import ConnectionOptions, vizard

pytestmark = [pytest.mark.system, pytest.mark.socket]

RIG = """
[scene]
kind = "stars"
camera = {kind = "basilisk", camera = 1}
[scene.sun]
direction = [0.0, 0.0, -1.0]
[camera.lens]
field_of_view_deg = 40.0
f_number = 1.4
[camera.sensor.noise]
rms = 0.06            # most events of these 50 ms
[run]
step_us = 5000
[[links]]
kind = "loopback"
"""
LONG_MS = 120_000


def state(t_ms, turn=0.0, numbers=(1,)):
    """Return a SIM_UPDATE; the cameras look along x and turn about z."""
    cameras = [(number, "craft", [0.0] * 3, [0.0] * 3) for number in numbers]
    return [b"SIM_UPDATE", b"", b"", update(t_ms * 1e6, [("craft", [0.0] * 3, [0.0, 0.0, turn])], cameras=cameras)]


@contextmanager
def run(tmp_path, *options, rig=RIG):
    """Start evstim; yield it, and what asks it."""
    (tmp_path / "rig.toml").write_text(rig)
    start = "from emulator.cli import main; main()"
    command = [sys.executable, "-c", start, "vizard", tmp_path / "rig.toml", "--at", "127.0.0.1:0", *options]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with zmq.Context() as context, context.socket(zmq.REQ) as peer:
        peer.setsockopt(zmq.LINGER, 0)
        process = subprocess.Popen([*command, "--json"], **pipes)
        address = process.stderr.readline().removeprefix("Basilisk may connect to ").strip()
        peer.connect(address)

        def ask(parts):
            peer.send_multipart(parts)
            assert peer.poll(LONG_MS), "no reply"
            return peer.recv_multipart()

        ask.leave, ask.address = peer.close, address
        try:
            yield process, ask
        finally:
            process.kill()
            process.communicate()


def ended(process):
    out, err = process.communicate(timeout=120)
    return process.returncode, json.loads(out.splitlines()[-1]), err


def test_a_simulation_from_its_first_ping_to_its_end(tmp_path):
    with run(tmp_path, "--white", "1e-3") as (process, ask):
        assert ask([b"PING"]) == [b"PONG"]
        for k in range(6):
            assert ask(state(1000 + 10 * k, 0.002 * k)) == [b"OK"]
            assert ask([b"REQUEST_INPUT"]) == [b"VIZARD_INPUT", b""]
        length, file = ask([b"REQUEST_IMAGE_1"])
        assert int.from_bytes(length, "big") == len(file)
        image = np.asarray(Image.open(BytesIO(file)))
        assert image.shape == (260, 346)
        assert image.dtype == np.uint8
        assert image.any()
        assert ask([b"REQUEST_IMAGE_2"]) == [bytes(4), b""]
        ask.leave()
        code, told, err = ended(process)
    basilisk = told["basilisk"]
    assert (code, told["problems"]) == (0, []), err
    assert (basilisk["updates"], basilisk["images"], basilisk["no_images"]) == (6, 1, 1)
    assert (basilisk["first_ns"], basilisk["last_ns"]) == (1_000_000_000, 1_050_000_000)
    assert (told["sim_seconds"], told["steps"]) == (pytest.approx(0.05), 10)
    assert told["links"]["loopback"]["state"] == "closed"
    assert 0 < basilisk["first_event_us"]["max"] <= basilisk["answer_us"]["max"]
    assert told["events"]["links"]["loopback"]["delivered"] > 100
    assert "Basilisk's camera has 346 x 260 pixels and a focal length of" in err


@pytest.mark.long
def test_two_cameras_on_one_trajectory(tmp_path):
    """The first passes every request on to the second; each gives its own images, and both run in step."""
    (tmp_path / "wide").mkdir()
    wide = RIG.replace("camera = 1", "camera = 2").replace("= 40.0", "= 80.0")
    both = [1, 2]
    with run(tmp_path / "wide", "--white", "1e-3", rig=wide) as (second, asked):
        options = "--white", "1e-3", "--forward", asked.address.removeprefix("tcp://")
        with run(tmp_path, *options) as (first, ask):
            for k in range(3):
                assert ask(state(10 * k, 0.002 * k, both)) == [b"OK"]
                assert ask([b"REQUEST_INPUT"]) == [b"VIZARD_INPUT", b""]
            files = [ask([b"REQUEST_IMAGE_%d" % number])[1] for number in both]
            images = [np.asarray(Image.open(BytesIO(file))) for file in files]
            assert ask([b"REQUEST_IMAGE_3"]) == [bytes(4), b""]
            ask.leave()
            told = [ended(first)[:2], ended(second)[:2]]
    assert [image.shape for image in images] == [(260, 346)] * 2
    assert not np.array_equal(*images)
    assert [code for code, _ in told] == [0, 0]
    assert [one["basilisk"]["images"] for _, one in told] == [1, 1]
    assert [one["basilisk"]["last_ns"] for _, one in told] == [20_000_000] * 2


@pytest.mark.long
def test_a_second_camera_that_is_not_there_or_goes_is_told(tmp_path):
    with run(tmp_path) as (second, asked):
        at = asked.address.removeprefix("tcp://")
        with run(tmp_path, "--forward", at) as (first, ask):
            assert ask([b"PING"]) == [b"PONG"]
            second.kill()
            assert ask(state(0)) == [f"ERROR: the visualiser at {at} has gone".encode()]
            ask.leave()
            code, told, _ = ended(first)
        assert (code, told["problems"]) == (1, [f"the visualiser at {at} has gone"])
        with pytest.raises(Failure, match=f"start it first: no program listens on {at}: Connection refused"):
            vizard(str(tmp_path / "rig.toml"), connection=ConnectionOptions("127.0.0.1:0", forward=at))


@pytest.mark.long
def test_one_that_ends_too_soon_makes_the_run_bad(tmp_path):
    with run(tmp_path, "--seconds", "5") as (process, ask):
        assert [ask(state(0)), ask(state(10))] == [[b"OK"], [b"OK"]]
        assert ask(state(10))[0].startswith(b"ERROR: simulated time went")
        ask.leave()
        code, told, _ = ended(process)
    assert code == 1
    refused, short = told["problems"]
    assert refused.startswith("1 requests refused")
    assert short == "the simulation ended after 0.01 of 5 s"


@pytest.mark.long
@pytest.mark.sampled
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_is_stopped_tells_its_summary(tmp_path, number):
    ready = tmp_path / "ready.json"
    with run(tmp_path, "--ready-file", str(ready)) as (process, ask):
        assert ask([b"PING"]) == [b"PONG"]
        assert ask(state(0)) == [b"OK"]
        assert json.loads(ready.read_text())
        process.send_signal(number)
        code, told, _ = ended(process)
    assert (code, told["problems"]) == (0, [])
    assert told["basilisk"]["updates"] == 1


def test_no_update_at_all_is_a_bad_run(tmp_path):
    ready = tmp_path / "ready.json"
    with run(tmp_path, "--ready-file", str(ready)) as (process, _):
        while not ready.exists():
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        code, told, _ = ended(process)
    assert (code, told["problems"]) == (1, ["no update came from Basilisk"])


@pytest.mark.parametrize(
    ("connection", "why"),
    [
        (ConnectionOptions("5556"), "is not HOST:PORT"),
        (ConnectionOptions("127.0.0.1:99999"), "is not HOST:PORT"),
        (ConnectionOptions("0.0.0.0:5556"), "can be reached from other machines"),
        (ConnectionOptions(allow=("everyone",)), "neither an address nor a network"),
        (ConnectionOptions(white=0.0), "must be above 0"),
        (ConnectionOptions(white=float("nan")), "must be above 0"),
    ],
)
def test_options_that_cannot_be_are_named(connection, why, tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    with pytest.raises(Failure, match=why):
        vizard(str(tmp_path / "rig.toml"), connection=connection)


def test_a_rig_without_such_a_path_is_refused():
    with pytest.raises(Failure, match='kind = "basilisk"'):
        vizard("eros")


@pytest.mark.parametrize("module", ["zmq", "google.protobuf"])
def test_what_is_not_installed_is_named(module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(Failure, match=r"pip install '\.\[basilisk\]'") as caught:
        vizard("eros")
    assert caught.value.exit_code == 3
