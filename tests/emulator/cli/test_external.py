"""`evstim run` with an external renderer, each a program of its own, and ends of either."""

import json
import signal
import subprocess
import sys

import pytest

from tests.free_ports import free_port

pytestmark = [pytest.mark.system, pytest.mark.socket, pytest.mark.timeout(600)]

RIG = """
[scene]
kind = "external"
port = {port}
period_ms = 20.0
timeout_s = {timeout_s}
ahead = {ahead}
white_w_m2_sr = 30.0

[camera]
model = "davis346"

[run]
pace = "free"
step_us = 5000
seconds = {seconds}

[[links]]
kind = "file"
path = "{path}"
"""
DRAW = """
import os, sys
import numpy as np
from evstim.renderer import Images, Renderer
with Renderer("127.0.0.1:" + sys.argv[1], Images(motion=True), shared=sys.argv[3] == "shared") as renderer:
    columns = np.arange(renderer.camera.width)
    for k, image in enumerate(renderer):
        if k == 20 and sys.argv[2] != "go on":
            if sys.argv[2] == "stall":
                print("stalls", file=sys.stderr, flush=True)
                sys.stdin.read()
            if sys.argv[2] == "end":
                renderer.end()
                break
            os._exit(9)
        image.light[:] = 1 + 0.5 * np.sin(columns / 5 - 100 * image.t_ns * 1e-9)
        image.motion[:] = 500.0, 0.0
        image.send()
"""


def ended(tmp_path, seconds, end, carrier="shared"):
    """Return exit code and summary of a run whose renderer ends in a way after 20 images."""
    port = free_port()
    rig = tmp_path / "external.toml"
    waits = {"timeout_s": 100.0, "ahead": 0} if end == "stall" else {"timeout_s": 2.0, "ahead": 1}
    rig.write_text(RIG.format(port=port, seconds=seconds, path=tmp_path / "events.aedat4", **waits))
    run = [sys.executable, "-c", "from emulator.cli import main; main()", "run", rig, "--json"]
    with (
        subprocess.Popen(
            [sys.executable, "-c", DRAW, str(port), end, carrier], stdin=subprocess.PIPE, stderr=subprocess.PIPE
        ) as renderer,
        subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as evstim,
    ):
        if end == "interrupt":
            for line in evstim.stderr:
                if "events to" in line:
                    break
            evstim.send_signal(signal.SIGINT)
        if end == "stall":
            renderer.stderr.readline()
            evstim.send_signal(signal.SIGINT)
        out, err = evstim.communicate()
        renderer.kill()
    assert out, err
    return evstim.returncode, json.loads(out.splitlines()[-1])


def rule(summary, name):
    return next((one for one in summary["rules"] if one["rule"] == name), None)


@pytest.mark.long
def test_both_carriers_give_the_same_events(tmp_path):
    digests = []
    for carrier in ("shared", "connection"):
        code, summary = ended(tmp_path, 0.5, "go on", carrier)
        assert (code, summary["balanced"], rule(summary, "scene")) == (0, True, None)
        assert summary["sim_seconds"] == 0.5
        digests.append(summary["links"]["file"]["digest"])
    assert digests[0] == digests[1]
    assert summary["events"]["read_out"] > 10_000


@pytest.mark.long
@pytest.mark.sampled
@pytest.mark.parametrize(
    ("end", "reason"), [("end", "its scene has ended after 0.38 of 5 s"), ("exit", "closed the connection")]
)
def test_a_renderer_that_ends_early_ends_the_run_and_nothing_is_lost(tmp_path, end, reason):
    code, summary = ended(tmp_path, 5.0, end)
    assert code == 1
    assert summary["balanced"]
    assert summary["sim_seconds"] == pytest.approx(0.38)
    assert summary["events"]["links"]["file"]["delivered"] == summary["events"]["read_out"] > 10_000
    assert reason in rule(summary, "scene")["told"]


@pytest.mark.long
def test_the_end_of_a_scene_is_the_end_of_a_run_without_one(tmp_path):
    code, summary = ended(tmp_path, 0, "end")
    assert (code, summary["balanced"], rule(summary, "scene")) == (0, True, None)
    assert summary["sim_seconds"] == pytest.approx(0.38)


def test_an_interrupt_ends_both(tmp_path):
    code, summary = ended(tmp_path, 0, "interrupt")
    assert (code, summary["balanced"]) == (0, True)


@pytest.mark.long
def test_an_interrupt_ends_the_wait_for_an_image(tmp_path):
    """The renderer stalls for good; the summary comes long before the rig's `timeout_s`, and has no trouble."""
    code, summary = ended(tmp_path, 0, "stall")
    assert (code, summary["balanced"], rule(summary, "scene")) == (0, True, None)
    assert summary["sim_seconds"] == pytest.approx(0.38)
