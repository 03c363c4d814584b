"""A camera in the guest itself, on the guest's own USB bus: FunctionFS, and dummy_hcd as its port and cable."""

import json
import shlex
import sys
from pathlib import Path

import numpy as np

from tests.guest.attachment import DAVIS_FX3, usb_bus
from tests.guest.running_rig import Delivered
from tests.hostile.looped import Looped

__all__ = ["CONTROLLER", "SLOWEST_LOOP_S", "GadgetCamera", "GadgetRig", "load_port", "loop_s"]

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).parent / "clients" / "gadget_camera.py"
CONTROLLER = "dummy_udc.0"
UDC = "/sys/kernel/config/usb_gadget/evstim/UDC"
# A processor that QEMU translates is slow, the more so on a busy machine.
START_TIMEOUT_S = 900.0
LIMIT_S = 7200.0
GAP_US = 10  # 0.1 million events a second

SLOWEST_LOOP_S = 0.4
"""Time of `loop_s` above which the guest cannot have a cable.

dummy_hcd looks at all transfers every 125 us. Where a look takes longer, because QEMU translates too slowly, one
processor of the guest does nothing else, and what runs on it never goes on: seen where the loop takes 0.9 s, and where
it takes 0.45 s (the test of all streams had not ended after ten minutes). A machine 2.3 times as fast as the first has
never shown it.
"""
LOOP = "import time; t = time.perf_counter(); sum(k & 7 for k in range(1_000_000)); print(time.perf_counter() - t)"

RIG = """
title = "recorded events, for a driver on the same machine"
[scene]
kind = "recording"
path = "looped.npz"
[camera]
start_delay_ms = 1000.0
[run]
step_us = 1000
max_late_ms = 0
[[links]]
kind = "usb_gadget"
"""


def load_port(guest, speed):
    """Give the guest a USB device port of a speed, "super" or "high", with its cable in the guest's own bus."""
    for module in ("libcomposite", "usb_f_fs"):
        guest.load(module)
    guest.run(["mount", "-t", "configfs", "none", "/sys/kernel/config"])  # refused where it is mounted
    guest.run(["rmmod", "dummy_hcd"])
    wide = "Y" if speed == "super" else "N"
    guest.check(["modprobe", "-d", str(guest.kernel.tree), "dummy_hcd", f"is_super_speed={wide}"])


def loop_s(guest):
    """Return the time of a million rounds of a loop of Python in the guest, s, the best of five."""
    return min(float(guest.check([sys.executable, "-c", LOOP])) for _ in range(5))


class GadgetCamera:
    """The link of a run that plays looped events in the guest until the block ends.

    `told` and `delivered` are known afterwards.

    Parameters
    ----------
    options
        Of clients/gadget_camera.py.
    looped
        The events.
    model
        (vendor, product) of the camera, as the bus tells them.
    """

    def __init__(self, guest, *options, looped=None, model=DAVIS_FX3):
        self._guest, self._options, self._model = guest, options, model
        self._looped = looped or Looped(300_000, GAP_US)
        self.device = {}
        self.told = {}
        self.finished = None

    def __enter__(self):
        # Process ids are kept: signals must reach this program and no other.
        (self._guest.results / "gadget.pids").unlink(missing_ok=True)
        command = self._command()
        line = f"exec env PYTHONPATH={shlex.quote(str(ROOT))} {shlex.join([sys.executable, *command])}"
        self._job = self._guest.start(["sh", "-c", f"echo $$ > {self._path('gadget.pids')}; {line}"], LIMIT_S)
        try:
            self.device = self.on_the_bus(1)
        except BaseException as error:
            self.kill()
            raise RuntimeError(f"no camera on the bus: {self.finished}") from error
        return self

    def __exit__(self, kind, error, at):
        self.stop()

    def on_the_bus(self, cameras):
        """Wait until the guest's bus shows so many cameras, 0 or 1; return what the kernel tells of the one."""
        devices = usb_bus(self._guest, cameras, START_TIMEOUT_S, self._model, on_cable=True)["devices"]
        return devices[0] if devices else {}

    def plug(self, *, connected):
        """Bind the gadget to its controller, or unbind it, behind the camera's back."""
        self._guest.check(["sh", "-c", f"echo '{CONTROLLER if connected else ''}' > {UDC}"])
        self.on_the_bus(int(connected))

    def stop(self):
        """End the run as Ctrl-C does; calling it again does nothing."""
        if self.finished is None:
            self._signal("INT")
            self.finished = self._job.wait()
            self.told = self._told(self.finished.stdout)

    def kill(self):
        """End its processes at once."""
        self._signal("KILL")
        self.finished = self._job.wait()

    @property
    def delivered(self):
        """The record; only after the end of the run."""
        return Delivered.load(self._guest.results / "gadget.npz")

    def _command(self):
        np.save(self._guest.results / "looped.npy", self._looped.events)
        files = ("--events", "looped.npy"), ("--record", "gadget.npz"), ("--pids", "gadget.pids")
        named = [word for option, name in files for word in (option, self._path(name))]
        return [str(PROGRAM), *named, "--round-us", str(self._looped.round_us), *self._options]

    def _told(self, stdout):
        return json.loads(stdout.splitlines()[-1])

    def _signal(self, name):
        whom = (
            f"$(cat {self._path('gadget.pids')})" if name == "KILL" else f"$(cut -d' ' -f1 {self._path('gadget.pids')})"
        )
        self._guest.check(["sh", "-c", f"kill -{name} {whom}"])

    def _path(self, name):
        return self._guest.path_in_guest(name)


class GadgetRig(GadgetCamera):
    """`evstim run` with a link usb_gadget."""

    def _command(self):
        self._looped.save(self._guest.results / "looped.npz")
        (self._guest.results / "gadget.toml").write_text(RIG)
        record = ["--record", self._path("gadget.npz")]
        return ["-m", "evstim", "run", self._path("gadget.toml"), "--json", "--seconds", str(LIMIT_S), *record]
