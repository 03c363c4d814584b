"""A camera that goes away under `evstim listen`: exit code 1 and a line that says so; an orderly end of a bus is 0."""

import json
import os
import signal
import socket
import subprocess
import sys

import pytest

from tests.waiting import until

pytestmark = [pytest.mark.system, pytest.mark.socket]
EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()"]
RIG = """
[scene]
kind = "checkerboard"
speed_px_s = {speed}
{sensor}
[run]
max_late_ms = 0
step_us = 5000
[[links]]
kind = "{kind}"
{more}
"""
PATIENT = "answer_ms = 20_000"  # ISO-TP gives up a message for which a busy machine does not answer within a second
KINDS = {"usbip": "port = 0", "serial": 'port = "pty"', "can": "port = {port}\n" + PATIENT}
SMALL = "[camera.sensor]\nwidth = 64\nheight = 48"  # fewer events than the narrow links can carry
RATES = [{"speed": 2.0, "sensor": SMALL}, {"speed": 10.0, "sensor": ""}]


class Bench:
    """A run and its listener, which both end with the test."""

    def __init__(self, folder, kind, seconds):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.rig, self.ready, self.log = folder / "a.toml", folder / "ready", folder / "listen.err"
        self.rig.write_text(RIG.format(kind=kind, more=KINDS[kind].format(port=port), **RATES[kind == "usbip"]))
        options = ["--seconds", str(seconds), "--json", "--ready-file", str(self.ready)]
        self.run = self._started(["run", str(self.rig), *options], subprocess.DEVNULL)
        until(self.ready.exists)
        address = next(iter(json.loads(self.ready.read_text())["links"].values()))
        arguments = {
            "usbip": ["--usbip", address],
            "serial": ["serial", address, "--start"],
            "can": ["can", str(self.rig)],
        }[kind]
        with self.log.open("w") as log:
            self.listener = self._started(["listen", *arguments, "--json"], log)

    def _started(self, arguments, err):
        return subprocess.Popen([*EVSTIM, *arguments], stdout=subprocess.PIPE, stderr=err, text=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in (self.listener, self.run):
            if process.poll() is None:
                process.kill()
            process.communicate()

    def wait_for_events(self):
        """Return when the listener's line of a second says that events have come."""
        until(lambda: any("kev/s" in line and " 0 events" not in line for line in self.log.read_text().splitlines()))

    def kill_link(self):
        found = subprocess.run(["pgrep", "-P", str(self.run.pid), "-f", "spawn_main"], capture_output=True, text=True)
        for pid in found.stdout.split():
            os.kill(int(pid), signal.SIGKILL)

    def result(self):
        out, _ = self.listener.communicate(timeout=60)
        return self.listener.returncode, json.loads(out.splitlines()[-1]), self.log.read_text()


@pytest.mark.sampled
@pytest.mark.parametrize("kind", KINDS)
def test_a_link_that_is_killed_ends_the_listener_with_one(tmp_path, kind):
    with Bench(tmp_path, kind, seconds=100) as bench:
        bench.wait_for_events()
        bench.kill_link()
        code, told, err = bench.result()
    assert (code, told["gone"]) == (1, True)
    assert told["events"] > 0
    assert len(told["problems"]) == 1
    assert "went away" in told["problems"][0]
    assert told["problems"][0] in " ".join(err.split())
    assert "Traceback" not in err


@pytest.mark.long
def test_the_orderly_end_of_a_bus_is_a_good_end(tmp_path):
    with Bench(tmp_path, "can", seconds=100) as bench:
        bench.wait_for_events()
        bench.run.send_signal(signal.SIGINT)
        code, told, err = bench.result()
    assert told["gone"] is True
    assert told["ended"] is True
    assert told["events"] > 0
    assert (code, told["problems"], told["faults"]) == (0, [], 0), (told, err)
