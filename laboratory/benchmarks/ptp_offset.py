"""A slave of the Precision Time Protocol beside ptp4l: its true error, its reported offset, its delay.

    python -m laboratory.benchmarks.ptp_offset [SECONDS [LOG_SYNC_INTERVAL]]      as root, with linuxptp

Two network namespaces, joined by a veth pair: in one ptp4l serves CLOCK_REALTIME with time stamps of the kernel, in the
other the camera's slave follows it. Both share the machine's clocks, so that the slave's true error can be read: its
time less CLOCK_REALTIME at the same instant, between two readings of CLOCK_MONOTONIC. Reading begins when it is locked.
"""

from __future__ import annotations

import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from firmware_protocol.ptp.slave import PortState
from tests.guest.own_network import OwnNetwork
from transports.gige.ptp_port import PtpPort, ptp_slave, realtime_ahead_ns

SLAVE, MASTER = "10.78.1.1", "10.78.1.2"
SETTINGS = """[global]
free_running 1
masterOnly 1
logAnnounceInterval 0
logSyncInterval {log}
logMinDelayReqInterval {log}
uds_address {uds}
"""
TURN_MS = 50  # as the process that answers hosts
WAIT_S = 60.0


def main() -> None:
    """Measure and print."""
    seconds, log = (*sys.argv[1:], "60", "0")[0], (*sys.argv[2:], "0")[0]
    program = shutil.which("ptp4l", path="/usr/sbin:/sbin:/usr/bin:/usr/local/sbin")
    if program is None:
        sys.exit("there is no ptp4l: apt install linuxptp")
    with OwnNetwork() as ours, OwnNetwork() as theirs, tempfile.TemporaryDirectory() as folder:
        ours.join(theirs, SLAVE, MASTER)
        settings = Path(folder) / "ptp4l.cfg"
        settings.write_text(SETTINGS.format(log=log, uds=Path(folder) / "uds"))
        master = subprocess.Popen(theirs.inside(program, "-4", "-S", "-i", "cable", "-f", str(settings)))
        subprocess.run(ours.inside(sys.executable, __file__, "follow", seconds), check=True)
        master.kill()
        master.wait()


def follow(seconds: float) -> None:
    """Follow the master in this network and print what was seen."""
    slave = ptp_slave(0x1C0FAFFFFE000001, 0)
    port = PtpPort(slave, SLAVE, (MASTER,))
    slave.enable()
    news = select.poll()
    for descriptor in port.descriptors:
        news.register(descriptor, select.POLLIN)
    begin_s, locked_s, rows = time.monotonic(), 0.0, []
    while not locked_s or time.monotonic() < locked_s + seconds:
        news.poll(TURN_MS)
        port.turn()
        if slave.state == PortState.SLAVE and slave.timebase is not None:
            locked_s = locked_s or time.monotonic()
            now_ns, status = time.monotonic_ns(), slave.status
            rows.append((slave.timebase.at(now_ns) - now_ns - realtime_ahead_ns(), status.offset_ns, status.delay_ns))
        elif time.monotonic() > begin_s + WAIT_S:
            sys.exit(f"no slave after {WAIT_S:.0f} s: {slave.state.name}, {dict(slave.counts)}")
    sys.stdout.write(f"SLAVE after {locked_s - begin_s:.1f} s; {len(rows)} readings in {seconds:.0f} s, in us:\n")
    for name, values in zip(("true error", "offset", "delay"), np.array(rows).T * 1e-3, strict=True):
        shares = ", ".join(f"{one:.2f}" for one in np.percentile(values, [0, 5, 50, 95, 100]))
        sys.stdout.write(f"{name}: least, 5 %, median, 95 %, most {shares}; rms {np.sqrt(np.mean(values**2)):.2f}\n")


if __name__ == "__main__":
    if sys.argv[1:2] == ["follow"]:
        follow(float(sys.argv[2]))
    else:
        main()
