"""Kill a random process of a run at a random moment, again and again: `python -m tests.hostile.kills COUNT [SEED]`.

A killed link must be reported and its events accounted for; the others go on, and the summary is written. A killed
session must leave no process behind.
"""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

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
    """Run, kill one process, and return what was killed; raises AssertionError where a promise breaks."""
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
    return "session" if victim == run.pid else "link"


def main(count, seed=1):
    """Kill `count` times and print how often what was killed."""
    draw, killed = random.Random(seed), {"session": 0, "link": 0}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(1, count + 1):
            killed[kill_once(draw, Path(folder))] += 1
            if number % 10 == 0:
                print(f"{number} kills: {killed}", flush=True)
    print(f"{count} kills: {killed['link']} links, {killed['session']} sessions; every promise kept")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
