"""The usbip tool of Linux, unmodified: it lists our cameras and understands a refusal. The guest tests attach."""

import shutil
import subprocess

import pytest

from firmware_protocol.davis346.device import Davis346

TOOL = shutil.which("usbip", path="/usr/sbin:/sbin:/usr/bin:/bin")
pytestmark = [
    pytest.mark.socket,
    pytest.mark.skipif(TOOL is None, reason="the usbip tool is missing: apt-get install usbip"),
]


def usbip(port, *words):
    done = subprocess.run([TOOL, "--tcp-port", str(port), *words], capture_output=True, text=True, timeout=120)
    return done.stdout + done.stderr


def test_lists_both_cameras(bench):
    bench.start({"1-1": Davis346(), "2-4": Davis346()})
    said = usbip(bench.server.port, "list", "-r", "127.0.0.1")
    assert "1-1: " in said
    assert "2-4: " in said
    assert said.count("(152a:841a)") == 2
    assert said.count("(ff/00/00)") == 2


def test_is_told_that_there_is_no_such_device(bench):
    bench.start({"1-1": Davis346()})
    assert "Device not found" in usbip(bench.server.port, "attach", "-r", "127.0.0.1", "-b", "9-9")
