"""Compilers, and the driver that runs the C library under sanitizers and answers over pipes."""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from firmware_protocol.c import FOLDER, sources
from firmware_protocol.events import EDGE, EVENT

HERE = Path(__file__).parent
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-Wshadow", "-ffreestanding"]
SANITIZED = ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


def compiler(name):
    """Return the path of a compiler; skip where there is none, but not in CI."""
    path = shutil.which(name)
    if path is None:
        reason = f"no {name}: apt-get install {PACKAGES[name]}"
        if os.environ.get("CI") == "true":
            pytest.fail(reason, pytrace=False)
        pytest.skip(reason)
    return path


PACKAGES = {"gcc": "gcc libc6-dev", "arm-none-eabi-gcc": "gcc-arm-none-eabi", "qemu-system-arm": "qemu-system-arm"}


def run(*command):
    """Run a tool; its own words are the failure."""
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    return done.stdout


def build_driver(folder):
    """Compile the library as firmware would, and the driver around it, all under sanitizers."""
    gcc, program = compiler("gcc"), folder / "driver"
    objects = []
    for source in sources():
        objects.append(folder / f"{source.stem}.o")
        run(gcc, *STRICT, *SANITIZED, "-c", source, "-o", objects[-1])
    hosted = [flag for flag in STRICT if flag != "-ffreestanding"]
    run(gcc, *hosted, *SANITIZED, "-I", FOLDER, HERE / "driver.c", *objects, "-o", program)
    return program


@dataclass(frozen=True)
class Reply:
    """What the library made of some bytes."""

    frames: list[bytes]
    events: np.ndarray
    edges: np.ndarray
    counters: list[int]


class Driver:
    """The driver, running; each call is one request. After a crash the next call starts it anew."""

    def __init__(self, program):
        self._program = program
        self._process = self._start()

    def _start(self):
        return subprocess.Popen([self._program], stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def __call__(self, mode, data, *, size=(346, 260), flags=0, piece=1 << 20):
        if self._process.poll() is not None:
            self.close()
            self._process = self._start()
        head = struct.pack("<cBHHII", mode.encode(), flags, *size, piece, len(data))
        self._process.stdin.write(head + data)
        self._process.stdin.flush()
        sizes = struct.unpack("<4I", self._read(16))
        frames, events, edges, counters = (self._read(n) for n in sizes)
        return Reply(
            list(_frames(frames)),
            np.frombuffer(events, EVENT),
            np.frombuffer(edges, EDGE),
            np.frombuffer(counters, "<u4").tolist(),
        )

    def _read(self, n):
        data = self._process.stdout.read(n)
        if len(data) < n:
            self._process.wait(60)
            pytest.fail("the driver died; what the sanitizer found is on stderr")
        return data

    def close(self):
        """End it; return its exit code, which tells of leaks too."""
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.stdout.close()
        return self._process.wait(60)


def _frames(data):
    while data:
        (n,) = struct.unpack_from("<I", data)
        yield data[4 : 4 + n]
        data = data[4 + n :]
