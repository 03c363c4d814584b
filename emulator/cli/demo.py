"""`evstim demo`: a run over USB/IP without hardware or kernel module, and the comparison of every event."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from emulator.cli.failures import failures
from emulator.cli.output import BAD_VERDICT, GOOD, WRONG_USE, Failure, console, print_json, status
from emulator.cli.preparing import prepared
from emulator.cli.run import summary
from emulator.cli.signals import stopped_by_signals
from emulator.rig.loading import Rig, UsbipLink, load_rig
from emulator.run.assembly import build_session, link_setups, schedule
from emulator.run.kernels import parts_of
from emulator.run.scene_assembly import build_scene
from emulator.run.session import RunResult, RunStatus
from transports.link.pacing import MonotonicClock
from transports.link.record import load_record

__all__ = ["demo"]


def demo(rig: str = "eros", /, *, seconds: float = 5.0, json: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Run a rig, read its camera over USB/IP in a second process, as a driver does, and compare every event.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one; it needs a usbip link.
    seconds
        Time for which the second process reads.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures(), tempfile.TemporaryDirectory() as folder:
        loaded = _on_a_free_port(load_rig(rig))
        sent, received = Path(folder, "sent.npz"), Path(folder, "received.npz")
        prepared(parts_of(loaded))
        status.print(f"{loaded.name}: {loaded.title}")
        result = _run(loaded, sent, received, seconds)
        verdict = _compare(sent, received)
    good = verdict["equal"] is True and result.good
    if json:
        print_json({**summary(loaded, result), "comparison": verdict, "good": good})
    else:
        _print_verdict(result, verdict, good)
    return GOOD if good else BAD_VERDICT


def _on_a_free_port(rig: Rig) -> Rig:
    links = [link for link in rig.links if isinstance(link, UsbipLink)]
    if not links:
        raise Failure(f"{rig.name} has no usbip link to attach to", WRONG_USE)
    return dataclasses.replace(rig, links=(dataclasses.replace(links[0], host="127.0.0.1", port=0),))


def _run(rig: Rig, sent: Path, received: Path, seconds: float) -> RunResult:
    """Start the receiver as soon as the camera has an address, and run until it ends."""
    link = rig.links[0]
    receiver: subprocess.Popen[bytes] | None = None
    with build_scene(rig) as scene:
        session = build_session(rig, scene, link_setups(rig, sent), MonotonicClock())

        def follow(now: RunStatus) -> None:
            nonlocal receiver
            address = now.links[link.name].address
            if receiver is None and address is not None:
                status.print(f"the camera is on the USB/IP port {address}; a second process attaches to it")
                receiver = _receiver(address, received, seconds)
            elif receiver is not None and receiver.poll() is not None:
                session.stop()

        try:
            plan = dataclasses.replace(schedule(rig), duration_ns=round((seconds + 60) * 1e9))
            with stopped_by_signals(session):
                return session.run(plan, follow)
        finally:
            if receiver is not None and receiver.poll() is None:
                receiver.terminate()
                receiver.wait(10)


def _receiver(address: str, received: Path, seconds: float) -> subprocess.Popen[bytes]:
    arguments = ["listen", "--usbip", address, "--seconds", str(seconds), "--record", str(received)]
    code = "from emulator.cli import main; main()"
    return subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.DEVNULL)


def _compare(sent: Path, received: Path) -> dict[str, object]:
    """Compare what was delivered since the last reset of the camera's clock with what arrived, event by event."""
    delivered, resets = load_record(sent)
    delivered = delivered[resets[-1] :] if resets else delivered
    if not received.exists():
        return {"sent": len(delivered), "received": 0, "equal": False, "why": "the second process wrote no record"}
    arrived, _ = load_record(received)
    equal = len(arrived) > 0 and np.array_equal(delivered, arrived)
    return {"sent": len(delivered), "received": len(arrived), "equal": equal}


def _print_verdict(result: RunResult, verdict: dict[str, object], good: bool) -> None:
    rate = result.frames / result.wall_seconds
    raised = result.ledger.raised
    seconds = result.sim_seconds
    console.print(f"{seconds:.1f} s of stream time, {rate:.0f} frames per second, {raised} events raised")
    console.print(f"{verdict['sent']} events sent since the last clock reset, {verdict['received']} received")
    console.print("all events are equal" if verdict["equal"] else "THE STREAMS DIFFER")
    balance = result.ledger.imbalance
    console.print("ledger: balanced" if not balance else f"ledger: OFF BY {balance} EVENTS")
    console.print("good" if good else "NOT GOOD")
