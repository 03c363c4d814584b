"""The camera's clock by GigE Vision's timestamp latch: how far is an estimate from the clock's true reading?

    python -m laboratory.benchmarks.clock_latch [SECONDS]

A camera whose clock drifts by 20 ppm is read on the loopback interface. Ten times a second a host notes the monotonic
clock, latches the camera's time, reads it, and takes the middle of the request for the host's time of the latch. The
truth is the line that `evstim run --truth` writes of the camera's clock. Two estimates are judged: each latch alone,
and `ClockEstimator` over all of them. Without a PTP master the latched time is the stream's as of the last millisecond.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from firmware_protocol.gige.registers import Register
from firmware_protocol.receiver.clock_estimator import ClockEstimator
from transports.gige.host import CameraGone, GigeHost

ADDRESS = "127.0.0.17"
LATCH = 1 << 1
RIG = f"""
[scene]
kind = "checkerboard"
square_px = 40.0
speed_px_s = 0.5
[camera]
model = "triton2"
[camera.clock]
drift_ppm = 20.0
[camera.sensor]
width = 64
height = 48
leak_hz = 0.0
[run]
step_us = 5000
[[links]]
kind = "gige"
host = "{ADDRESS}"
"""

Numbers = npt.NDArray[np.float64]


def latched(host: GigeHost) -> tuple[int, int, int]:
    """Return the camera's clock, and CLOCK_MONOTONIC before and after the request, ns."""
    before_ns = time.monotonic_ns()
    host.write(Register.TIME_CONTROL, LATCH)
    after_ns = time.monotonic_ns()
    clock_ns = host.read_register(Register.TIME_HIGH) << 32 | host.read_register(Register.TIME_LOW)
    return clock_ns, before_ns, after_ns


def main() -> None:
    """Measure and print."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 30.0
    with tempfile.TemporaryDirectory() as folder:
        rig, truth, ready = (Path(folder) / name for name in ("latch.toml", "truth.csv", "ready"))
        rig.write_text(RIG)
        command = [sys.executable, "-c", "from emulator.cli import main; main()", "run", str(rig), "--quiet"]
        command += ["--seconds", str(seconds + 10), "--truth", str(truth), "--ready-file", str(ready)]
        run = subprocess.Popen(command)
        while not ready.exists() and run.poll() is None:
            time.sleep(0.1)
        taken = _taken(seconds)
        run.wait()
        _judge(np.array(taken, np.int64), np.loadtxt(truth, delimiter=",", skiprows=1))


def _taken(seconds: float) -> list[tuple[int, int, int]]:
    host = GigeHost(ADDRESS, now_ns=time.monotonic_ns)
    end_s, taken = time.monotonic() + seconds, []
    with suppress(CameraGone):  # its run has ended
        while time.monotonic() < end_s:
            taken.append(latched(host))
            time.sleep(0.1)
        host.close()
    return taken


def _judge(taken: npt.NDArray[np.int64], truth: Numbers) -> None:
    """Print the errors: of a latch by itself, and of the estimator at the end."""
    origin_ns = int(truth[0, 0])
    clock_ns, middle_ns = taken[:, 0], (taken[:, 1] + taken[:, 2]) // 2
    slope, offset_us = np.polyfit(truth[:, 0] - origin_ns, truth[:, 2], 1)
    true_ns = 1000 * (slope * (middle_ns - origin_ns) + offset_us)
    inside = clock_ns > 0
    _show("a latch", (clock_ns - true_ns)[inside] * 1e-3)
    _show("half of its request", (taken[:, 2] - taken[:, 1])[inside] / 2000)
    estimator = ClockEstimator()
    for clock, after in zip(clock_ns[inside].tolist(), taken[:, 2][inside].tolist(), strict=True):
        estimator.add(clock, after)
    line = estimator.estimate
    if line is None:
        return
    last_ns = int(clock_ns[-1])
    true_host_ns = origin_ns + (last_ns / 1000 - offset_us) / slope
    sys.stdout.write(
        f"ClockEstimator after {len(clock_ns)} latches: {(line.host_ns(last_ns) - true_host_ns) * 1e-3:.1f} us late, "
        f"drift {line.drift_ppm:.2f} ppm\n"
    )


def _show(name: str, values: Numbers) -> None:
    shares = ", ".join(f"{one:.1f}" for one in np.percentile(values, [0, 5, 50, 95, 100]))
    sys.stdout.write(f"{name}: least, 5 %, median, 95 %, most of {len(values)}: {shares} us\n")


if __name__ == "__main__":
    main()
