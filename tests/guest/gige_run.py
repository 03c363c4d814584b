"""`evstim run` of recorded events at their own pace, on GigE Vision, and the record of what it delivered."""

import json
import signal
import subprocess
import sys
import time

from tests.hostile.looped import Looped
from transports.recording.record import load_record

__all__ = ["HD", "LOSS", "GigeRun", "RigRun"]

HD = (1280, 720)

RIG = """
title = "recorded events at their own pace, on GigE Vision"
[scene]
kind = "recording"
path = "looped.npz"
[camera]
model = "triton2"
[run]
step_us = 1000
max_late_ms = 0
{run}
[[links]]
kind = "gige"
"""

LOSS = """
[[faults]]
link = "gige"
kind = "lost_datagrams"
rate = 0.01
count = 0
at_s = 0.0
for_s = 1000.0
"""


class RigRun:
    """A run of a rig until it is stopped.

    Parameters
    ----------
    folder
        Existing folder for the rig and what the run writes.
    text
        The rig.
    inside
        Gives the command that runs a command elsewhere, in a network of its own for example.
    """

    def __init__(self, folder, text, inside=lambda *command: [*command]):
        rig, ready, self._record = folder / "gige.toml", folder / "ready", folder / "delivered.npz"
        rig.write_text(text)
        command = [sys.executable, "-c", "from emulator.cli import main; main()", "run", str(rig), "--json"]
        command += ["--seconds", "600", "--record", str(self._record), "--ready-file", str(ready)]
        self._process = subprocess.Popen(inside(*command), stdout=subprocess.PIPE, text=True)
        while not ready.exists():
            assert self._process.poll() is None, "the run ended at once"
            time.sleep(0.05)

    def stop(self):
        """End it; returns its summary, which must balance, and what it delivered since the camera was last started."""
        self._process.send_signal(signal.SIGINT)
        out, _ = self._process.communicate(timeout=120)
        delivered, resets = load_record(self._record)
        summary = json.loads(out.splitlines()[-1])
        assert summary["balanced"], summary
        return summary, delivered[resets[-1] if len(resets) else 0 :]

    def kill(self):
        """End it in any case."""
        self._process.kill()
        self._process.communicate()


class GigeRun(RigRun):
    """A run that plays looped events, `keys` being further lines of the link's table, and `run` of the run's."""

    def __init__(self, folder, keys="", looped=None, run="", **more):
        (looped or Looped(500_000, 10, HD)).save(folder / "looped.npz")
        super().__init__(folder, RIG.format(run=run) + keys, **more)
