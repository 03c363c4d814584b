"""A random process of a run is killed at a random moment, again and again; twice by default.

    EVSTIM_KILLS=200 python -m pytest tests/hostile/test_kills.py --timeout 0

A killed link must be reported and its events accounted for; the others go on, and the summary is written. A killed
session must leave no process behind.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest

KILLS = int(os.environ.get("EVSTIM_KILLS", "2"))
RIG = """
title = "three links"
[scene]
kind = "checkerboard"
[camera]
model = "davis346"
[run]
max_late_ms = 0
[[links]]
kind = "loopback"
[[links]]
kind = "usbip"
port = 0
[[links]]
kind = "serial"
"""
RUN = [sys.executable, "-c", "from emulator.cli import main; main()", "run"]


def children(pid):
    """Return the processes of the links."""
    found = subprocess.run(["pgrep", "-P", str(pid), "-f", "spawn_main"], capture_output=True, text=True)
    return [int(child) for child in found.stdout.split()]


def kill_once(draw, folder):
    """Run and kill one process; raises AssertionError where a promise breaks."""
    rig, ready = folder / "three.toml", folder / "ready"
    rig.write_text(RIG)
    ready.unlink(missing_ok=True)
    arguments = [str(rig), "--json", "--seconds", "6", "--ready-file", str(ready)]
    with subprocess.Popen([*RUN, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        while not ready.exists():
            assert run.poll() is None, run.stderr.read()
            time.sleep(0.02)
        links = children(run.pid)
        victim = draw.choice([run.pid, *links])
        time.sleep(draw.uniform(0.0, 2.5))
        os.kill(victim, signal.SIGKILL)
        out, err = run.communicate(timeout=600)  # a machine with much else to do may need minutes
    assert "Traceback" not in err, err
    if victim != run.pid:
        summary = json.loads(out.splitlines()[-1])
        assert run.returncode == 1
        assert summary["balanced"], summary["events"]
        assert sum(link["error"] is not None for link in summary["links"].values()) == 1
    until_s = time.monotonic() + 120
    while any(os.path.exists(f"/proc/{link}") for link in links):
        assert time.monotonic() < until_s, "a link outlived its session"
        time.sleep(0.05)


@pytest.mark.long
@pytest.mark.system
@pytest.mark.socket
def test_a_killed_process_breaks_no_promise(tmp_path):
    draw = random.Random(5)
    for _ in range(KILLS):
        kill_once(draw, tmp_path)
