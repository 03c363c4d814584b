"""The drivers under test, each in a virtual environment of its own, made once by pip and kept in the cache.

**neuromorphic_drivers may abort when it is closed after an unplugging.** Its `TransferManager::drop` (src/usb.rs, 0.18)
cancels each active transfer and marks it complete when libusb refuses, as libusb does for a device that is gone; when
the transfer's callback then comes all the same, it panics in a C callback, and SIGABRT ends the process. The iterator
has told of the missing device by then. Its driver of the SilkyEvCam VGA does not stop the camera when it is closed, so
that transfers are cancelled amid the stream: there it aborts (4 of 4 times in the guest) without an unplugging.

**neuromorphic_drivers has no frames after a change of the region of interest.** `update_configuration` (0.16 source,
0.18.2 as traced) writes APS RUN = 0, the region and then APS RUN = 0 again, where 1 is meant. So frames stay off until
somebody else writes that register; here the client does.

**dv-processing 2.0.4 does not return from `getGeneratorLowTime`.** It takes the camera's mutex, and what gives the high
time within it takes the same mutex again, as its machine code shows: no camera can help that.

**dv-processing 2.0.4 loses data in `setTransfersNumber` and `setTransfersSize`.** Both replace all transfers while the
camera streams. Frames then have wrong numbers of columns; and once a timestamp went back by 9 ms, as after the loss of
a wrap of 32.8 ms, for which the driver ends the stream.

**dv-processing 2.0.4 leaves the events off after `setExternalAERControl(False)`.** To hand the chip over it writes DVS
RUN = 0, and to take it back only register 5; `setEventsRunning(True)` after `setEventsRunning(False)` starts them.

**dv-processing 1.7.9 corrupts its memory where it is read while a timestamp reset comes.** The thread that takes USB
transfers then empties the queues (`clearBuffers` in a public copy of io/camera_capture.hpp, of unknown version), which
are boost::lockfree::spsc_queue: only their one reader may do that. A client that let them fill, reset and read on ended
with "double free or corruption" after 40 and after 20 resets; one that read nothing for half a second, not in 98.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

from tests.guest.cache import made_once
from tests.guest.image import GuestUnavailable

__all__ = ["DRIVERS", "EVENTCV", "ND_EVK3", "ND_EVK4", "ND_VGA", "Driver"]

CLIENTS = Path(__file__).with_name("clients")


@dataclass(frozen=True)
class Driver:
    """An unmodified driver: what pip installs, and the program of `clients/` that uses it.

    Attributes
    ----------
    name
        Of the client's program and of the environment.
    packages
        What pip installs.
    adds_host_time
        True for the drivers of iniVation: they open with a timestamp reset, throw away what came before it, and add the
        host's time of the reset to every event. neuromorphic_drivers shows device time as it is, from the first event.
    imports
        Packages that its program imports slowly, see `Guest.prepare`.
    abort_after_unplugging
        What the driver may say when closing a camera that is gone ends its process; empty: it closes cleanly.
    stops_camera
        False: it closes a camera that still streams, and its process may end as after an unplugging.
    pythons
        Versions of Python that the driver's wheels exist for; empty: any that this project runs on.
    options
        Of its program.
    """

    name: str
    packages: tuple[str, ...]
    adds_host_time: bool
    imports: tuple[str, ...] = ()
    abort_after_unplugging: str = ""
    stops_camera: bool = True
    pythons: tuple[str, ...] = ()
    options: tuple[str, ...] = ()

    @property
    def program(self):
        """The stand-alone client."""
        return CLIENTS / f"{self.name}.py"

    def python(self, cache):
        """Return the environment's interpreter, making the environment on the first call for these packages.

        Raises GuestUnavailable when no fitting Python is here or pip cannot install the packages.
        """
        environment = cache / f"venv-{self.name}-{zlib.crc32(' '.join(self.packages).encode()):08x}"
        return made_once(environment, self._make) / "bin" / "python"

    def _make(self, environment):
        """Only `bin/python` is used later, so the environment may be moved after pip has filled it."""
        interpreter = str(environment / "bin" / "python")
        for command in (
            [self._base_python(), "-m", "venv", str(environment)],
            [interpreter, "-m", "pip", "install", "--quiet", "--only-binary=:all:", *self.packages],
        ):
            done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
            if done.returncode != 0:
                raise GuestUnavailable(f"cannot install {' '.join(self.packages)}: {done.stderr.strip()}")

    def _base_python(self):
        running = f"{sys.version_info.major}.{sys.version_info.minor}"
        if not self.pythons or running in self.pythons:
            return sys.executable
        for version in self.pythons:
            found = shutil.which(f"python{version}")
            if found is not None:
                return found
        raise GuestUnavailable(f"{self.packages[0]} has wheels only for Python {', '.join(self.pythons)}, not found")


DV_IMPORTS = ("numpy", "dv_processing")
ND_IMPORTS = ("numpy", "neuromorphic_drivers")

DRIVERS = (
    Driver("dv2", ("dv-processing==2.0.4", "numpy"), adds_host_time=True, imports=DV_IMPORTS),
    Driver("dv1", ("dv-processing==1.7.9", "numpy<2"), adds_host_time=True, imports=DV_IMPORTS, pythons=("3.11",)),
    Driver(
        "nd",
        ("neuromorphic_drivers==0.18.2", "numpy", "pyusb==1.3.1"),
        adds_host_time=False,
        imports=ND_IMPORTS,
        abort_after_unplugging="callback called for a transfer marked as complete",
    ),
)

ND_EVK4 = replace(DRIVERS[-1], name="nd_evk4", packages=())
"""The program for boards of Prophesee's, here an EVK4, in the environment of neuromorphic_drivers."""

ND_EVK3 = replace(ND_EVK4, options=("--device", "prophesee_evk3_hd"))
"""The EVK3 HD there: another driver, which writes registers by frames without a size."""

ND_VGA = replace(ND_EVK4, options=("--device", "centuryarks_vga"), stops_camera=False)
"""The SilkyEvCam VGA there: its driver writes values in mV where the chip has codes."""

EVENTCV = Driver("ecv", ("eventcv==1.0.8", "numpy"), adds_host_time=False, imports=("numpy", "eventcv"))
"""A library of computer vision with neuromorphic_drivers 0.17 inside; it reads the EVK4 alone of our cameras."""
