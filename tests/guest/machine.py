"""A Linux guest in QEMU: boots Debian's kernel on the host's own files and runs programs in it.

Nothing needs root, KVM or a network: the host's root directory is a read-only 9p share, QEMU's user network carries
the guest's TCP connections to the host's loopback interface (10.0.2.2 in the guest), and one folder is writable.
"""

from __future__ import annotations

import json
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.guest.image import GuestUnavailable, build_initramfs, fetch_kernel

__all__ = ["CACHE", "HOST_ADDRESS", "Finished", "Guest", "Job"]

CACHE = Path(__file__).parents[2] / ".cache" / "guest"
HOST_ADDRESS = "10.0.2.2"
RESULTS_IN_GUEST = Path("/evstim-results")
AGENT = Path(__file__).with_name("agent.py")
BOOT_TIMEOUT_S = 300.0
GUEST_LIFE_S = 1e6
LOOK_PERIOD_S = 0.5  # how often to see whether QEMU is still there
CONSOLE_TAIL_LINES = 40


@dataclass(frozen=True)
class Finished:
    """A program of the guest that has ended; `code` is None when its time ran out."""

    argv: tuple[str, ...]
    code: int | None
    stdout: str
    stderr: str

    @property
    def ok(self):
        """True when the program ended with code 0."""
        return self.code == 0

    def __str__(self):
        end = "ran out of time" if self.code is None else f"ended with {self.code}"
        return f"{shlex.join(self.argv)} {end}\n{self.stdout}{self.stderr}"


class Job:
    """A program that runs in the guest."""

    def __init__(self, argv, connection, timeout_s):
        self._argv = tuple(argv)
        self._connection = connection
        # The agent keeps the time; the margin is for a guest that no longer answers.
        connection.settimeout(timeout_s + 30)
        connection.sendall(json.dumps({"argv": self._argv, "timeout_s": timeout_s}).encode() + b"\n")

    def wait(self):
        """Wait for the end of the program; raises TimeoutError or ConnectionError when the guest is gone."""
        with self._connection.makefile("rb") as lines:
            reply = lines.readline()
        self.close()
        if not reply:
            raise ConnectionError(f"the guest left while {shlex.join(self._argv)} ran")
        return Finished(self._argv, **json.loads(reply))

    def close(self):
        """Hear no more of the program."""
        self._connection.close()


class Guest:
    """A booted guest; a context manager that always ends QEMU.

    Parameters
    ----------
    results
        Existing folder of the host that the guest may write; see `path_in_guest`.
    """

    def __init__(self, results):
        self.results = results
        self.console_file = results / "console.log"
        self._jobs = []
        self.kernel = fetch_kernel(CACHE)
        self._listener = _listener()
        self._listeners = {}
        try:
            self._qemu = self._power_on()
        except BaseException:
            self._listener.close()
            raise
        self._wait_until_up()

    def __enter__(self):
        return self

    def __exit__(self, kind, error, at):
        self.close()

    def close(self):
        """End the guest."""
        for job in self._jobs:
            job.close()
        for listener in (self._listener, *self._listeners.values()):
            listener.close()
        self._qemu.kill()
        self._qemu.wait()

    def start(self, argv, timeout_s):
        """Start a program in the guest as root; by fork where its interpreter was prepared."""
        job = Job(argv, self._idle_connection(self._listeners.get(argv[0], self._listener)), timeout_s)
        self._jobs.append(job)
        return job

    def prepare(self, python, modules, path=""):
        """Start an interpreter that has imported modules, also from `path`, for all that `python` runs from now on."""
        if str(python) in self._listeners or not modules:
            return
        listener = _listener()
        program = [str(python), str(AGENT), HOST_ADDRESS, _port(listener), *modules]
        self.start(["env", f"PYTHONPATH={path}", *program], GUEST_LIFE_S)
        self._listeners[str(python)] = listener

    def run(self, argv, timeout_s=120.0):
        """Run a program in the guest as root and wait for its end."""
        return self.start(argv, timeout_s).wait()

    def check(self, argv, timeout_s=120.0):
        """Run a program that must succeed and return its output; raises RuntimeError with all that it said."""
        finished = self.run(argv, timeout_s)
        if not finished.ok:
            raise RuntimeError(f"{finished}\nconsole of the guest:\n{self.console}")
        return finished.stdout

    @contextmanager
    def suspended(self):
        """Let the whole machine stand still until the block ends."""
        self._qemu.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self._qemu.send_signal(signal.SIGCONT)

    def load(self, module):
        """Load a kernel module from the unpacked package."""
        self.check(["modprobe", "-d", str(self.kernel.tree), module])

    def path_in_guest(self, name):
        """Path under which the guest writes the file that the host finds as `results`/name."""
        return str(RESULTS_IN_GUEST / name)

    @property
    def console(self):
        """The last lines of the guest's console."""
        return "\n".join(self.console_file.read_text(errors="replace").splitlines()[-CONSOLE_TAIL_LINES:])

    def _idle_connection(self, listener):
        """Take the connection that an agent of the guest keeps open; raises RuntimeError when there is none in time."""
        deadline = time.monotonic() + BOOT_TIMEOUT_S
        while time.monotonic() < deadline and self._qemu.poll() is None:
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            return connection
        trouble = "does not answer" if self._qemu.returncode is None else f"left with code {self._qemu.returncode}"
        raise RuntimeError(f"the guest {trouble}; its console:\n{self.console}")

    def _power_on(self):
        initramfs = self.results / "initramfs.gz"
        settings = {"PYTHON": sys.executable, "AGENT": str(AGENT), "PORT": _port(self._listener)}
        build_initramfs(self.kernel, settings, initramfs)
        with self.console_file.open("wb") as console:
            return subprocess.Popen(
                self._command_line(initramfs), stdin=subprocess.DEVNULL, stdout=console, stderr=subprocess.STDOUT
            )

    def _wait_until_up(self):
        try:
            self.check(["true"])
        except BaseException:
            self.close()
            raise

    def _command_line(self, initramfs):
        qemu = shutil.which("qemu-system-x86_64")
        if qemu is None:
            raise GuestUnavailable("no qemu-system-x86_64: apt-get install qemu-system-x86")
        share = "local,security_model=none,multidevs=remap"
        return [
            *(qemu, "-M", "pc", "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2", "-m", "2048"),
            *("-nographic", "-nodefaults", "-no-reboot", "-serial", "stdio"),
            *("-kernel", str(self.kernel.image), "-initrd", str(initramfs)),
            # Lower levels tell of each transfer of a camera that is unplugged, and a serial console is slow.
            # On a busy machine the timer that the kernel checks at its start comes late, and the kernel gives up.
            *("-append", "console=ttyS0 loglevel=5 panic=-1 mitigations=off no_timer_check"),
            *("-virtfs", f"{share},path=/,mount_tag=host,readonly=on"),
            *("-virtfs", f"{share},path={self.results},mount_tag=results"),
            *("-netdev", "user,id=host", "-device", "virtio-net-pci,netdev=host,romfile="),
        ]


def _listener():
    """Return a socket for the connections of an agent."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(LOOK_PERIOD_S)
    return listener


def _port(listener):
    return str(listener.getsockname()[1])
