"""`evstim demo`: a run that a second process reads as a driver does, without hardware or kernel module.

Over USB/IP the reader is evstim's own; over GigE Vision it is neuromorphic_drivers, unmodified, where it is installed.
Every event is compared. `evstim demo landing` flies a landing instead.
"""

from __future__ import annotations

import dataclasses
import subprocess
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from emulator.cli.demo_landing import fly_landing
from emulator.cli.demo_readers import reader_of
from emulator.cli.failures import failures
from emulator.cli.output import BAD_VERDICT, GOOD, WRONG_USE, Failure, console, print_json, status
from emulator.cli.preparing import prepared
from emulator.cli.run import summary
from emulator.cli.run_output.lateness import lateness_lines
from emulator.cli.signals import ignore_stop_signals, stop_on_signals
from emulator.rig.loading import Rig, UsbipLink, load_rig
from emulator.run.assembly import build_session, link_setups, schedule
from emulator.run.free_ports import free_loopback_address
from emulator.run.kernels import parts_of
from emulator.run.outcome import RunResult, RunStatus
from emulator.run.scene_assembly import build_scene
from firmware_protocol.gige.gvcp import GVCP_PORT
from transports.gige.parameters import GigeLink
from transports.link.pacing import MonotonicClock
from transports.recording.record import load_record

__all__ = ["demo"]


def demo(rig: str = "eros", /, *, seconds: float = 5.0, json: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Run a rig, read its camera in a second process, as a driver does, and compare every event.

    The camera is on USB/IP or on GigE Vision; the latter is read by neuromorphic_drivers where that is installed.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one; it needs a usbip or a gige link. Or `landing`: a landing from
        60 m, guided by events, is flown instead.
    seconds
        Time for which the second process reads.
    json
        Print one JSON object as the last line on stdout.
    """
    if rig == "landing":
        with failures():
            return fly_landing(as_json=json)
    with failures(), tempfile.TemporaryDirectory() as folder:
        loaded = _on_a_free_port(load_rig(rig))
        sent, received = Path(folder, "sent.npz"), Path(folder, "received.npz")
        prepared(parts_of(loaded))
        status.print(f"{loaded.name}: {loaded.title}")
        result = _run(loaded, sent, received, seconds)
        ignore_stop_signals()
        verdict = _compare(sent, received, whole=isinstance(loaded.links[0], UsbipLink))
    good = verdict["equal"] is True and result.good
    if json:
        print_json({**summary(loaded, result), "comparison": verdict, "good": good})
    else:
        _print_verdict(result, verdict, good)
        for line in lateness_lines(loaded, result):
            console.print(line)
    return GOOD if good else BAD_VERDICT


def _on_a_free_port(rig: Rig) -> Rig:
    """Return the rig with its camera alone, where no other program is: drivers know one port of GigE Vision.

    The demo compares events: that a machine is late now and then is shown, and judged by `run`.
    """
    rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, max_late_share=1.0))
    for link in rig.links:
        if isinstance(link, UsbipLink):
            return dataclasses.replace(rig, links=(dataclasses.replace(link, host="127.0.0.1", port=0),))
        if isinstance(link, GigeLink):
            alone = dataclasses.replace(link, host=free_loopback_address(GVCP_PORT), port=GVCP_PORT, allow=())
            return dataclasses.replace(rig, links=(alone,))
    raise Failure(f"{rig.name} has no usbip link and no gige link to attach to", WRONG_USE)


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
                reader = reader_of(link.kind)
                status.print(f"the camera is at {address}; {reader.told} attaches to it in a second process")
                receiver = reader.start(address, received, seconds)
            elif receiver is not None and receiver.poll() is not None:
                session.stop()

        try:
            plan = dataclasses.replace(schedule(rig), duration_ns=round((seconds + 60) * 1e9))
            stop_on_signals(session.stop)
            return session.run(plan, follow)
        finally:
            if receiver is not None and receiver.poll() is None:
                receiver.terminate()
                receiver.wait(10)


def _compare(sent: Path, received: Path, *, whole: bool) -> dict[str, object]:
    """Compare what was delivered since the last reset of the camera's clock with what arrived, event by event.

    Over UDP, which has no end, a reader that leaves first has seen how the stream begins.
    """
    delivered, resets = load_record(sent)
    delivered = delivered[resets[-1] :] if resets else delivered
    if not received.exists():
        return {"sent": len(delivered), "received": 0, "equal": False, "why": "the second process wrote no record"}
    arrived, _ = load_record(received)
    expected = delivered if whole else delivered[: len(arrived)]
    equal = len(arrived) > 0 and np.array_equal(expected, arrived)
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
