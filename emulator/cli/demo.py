"""`evstim demo`: a run whose camera is read by a second process, as a driver does, without hardware or kernel module.

Over USB/IP the reader is evstim's own; over GigE Vision it is neuromorphic_drivers, unmodified, where it is installed.
Every event is compared. `evstim demo landing` flies the landing of examples/landing instead, from start to touchdown.
"""

from __future__ import annotations

import dataclasses
import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from emulator.cli.checks import failures
from emulator.cli.driver_client import DRIVER, driver_works
from emulator.cli.output import BAD_VERDICT, GOOD, LACKING, WRONG_USE, Failure, Json, console, print_result, status
from emulator.cli.picture import PictureOptions, draw
from emulator.cli.run import Files, RunParts, rig_with_options, run_with_files, summary
from emulator.rig.loading import Rig, load_rig
from emulator.run.machine import free_loopback_address
from emulator.run.outcome import RunResult, RunStatus
from emulator.run.session import Session
from firmware_protocol.gige.gvcp import GVCP_PORT
from transports.gige.kind import GigeLink
from transports.output_file import TemporaryFolder, lasting_folder
from transports.recording.record import load_record
from transports.usb.kind import UsbipLink

_HEIGHT_M = 500.0
_MOVIE_S, _MOVIE_FPS = 2.0, 10  # a small file that is written in about a second
_SLOWER = 1.05  # than real time, to be mentioned: a run that keeps up may end a step late


def fly_landing(guidance: str = "", report: Path | None = None, *, as_json: bool) -> int:
    """Fly one landing, by the law FILE.py:NAME where one is given, its descent on stderr; return the exit code."""
    out = report or lasting_folder("landing")
    status.print(f"a lander falls from {_HEIGHT_M:g} m, guided by events; about 65 s of flight; files in {out}")
    law = ["--guidance", guidance] if guidance else ["--compare"]
    command = [sys.executable, str(_program()), "--height", str(_HEIGHT_M), *law, "--out", str(out)]
    code = subprocess.run(command, stdout=sys.stderr, check=False).returncode
    file = out / "verdict.json"
    if not file.exists():
        exit_code = code if code in (WRONG_USE, LACKING) else BAD_VERDICT
        raise Failure(f"the landing did not begin: fly.py ended with {code}, see above", exit_code)
    verdict = json.loads(file.read_text())
    print_result(as_json, {**verdict, "good": verdict["soft"], "folder": str(out)}, _landing_lines(verdict))
    return GOOD if verdict["soft"] else BAD_VERDICT


def _program() -> Path:
    """Return the example's program: in the package when installed, else in the checkout."""
    for folder in ("evstim/examples", "examples"):
        if (program := Path(__file__).parents[2] / folder / "landing" / "fly.py").is_file():
            return program
    raise Failure("examples/landing is not here: it comes with evstim and lies in its repository", WRONG_USE)


def _landing_lines(verdict: dict[str, Any]) -> Iterator[str]:
    if verdict["touched"]:
        yield f"with events: {_ended(verdict)}"
    for name, other in verdict.get("others", {}).items():
        yield f"same start, {_OTHERS[name]}: {_ended(other)}"
    if "error_median" in verdict:
        yield f"divergence from events: {100 * verdict['error_median']:.1f} % off in the median"
    yield from verdict["why"]
    yield "good" if verdict["soft"] else "NOT GOOD: not a landing within the bounds"


_OTHERS = {"blind": "by its IMU and star tracker alone", "altimeter": "with an altimeter in place of the camera"}


def _ended(verdict: dict[str, Any]) -> str:
    """Return the figures of one end."""
    text = f"touchdown after {verdict['t_s']:.1f} s at {verdict['vertical_m_s']:.2f} m/s down"
    if "horizontal_m_s" in verdict:
        text += f", {verdict['horizontal_m_s']:.2f} m/s along the ground, {verdict['place_m']:.1f} m from the site"
    return text if verdict.get("touched", True) else f"no touchdown within {verdict['t_s']:.0f} s"


_PATH = "import json, sys; sys.path[:] = json.loads(sys.argv.pop(1)); "
_START = _PATH + "from emulator.cli import main; main()"
_DRIVER = _PATH + "from emulator.cli.driver_client import main; sys.exit(main(*sys.argv[1:]))"


def start_reader(kind: str, address: str, record: Path) -> subprocess.Popen[bytes]:
    """Start the reader of a camera, which ends with SIGINT: for GigE Vision a third-party driver, if it works."""
    if kind == "gige" and driver_works():
        description, code = f"{DRIVER}, unmodified,", _DRIVER
        arguments = [address.rpartition(":")[0], str(record)]
    else:
        advice = "" if kind == "usbip" else f" (pip install {DRIVER} for a third-party driver)"
        description, code = f"evstim's own receiver{advice}", _START
        camera = ["--usbip", address] if kind == "usbip" else ["gige", address]
        arguments = ["listen", *camera, "--record", str(record)]
    status.print(f"the camera is at {address}; {description} attaches to it in a second process")
    command = [sys.executable, "-P", "-c", code, json.dumps(sys.path), *arguments]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def demo(
    rig: str = "stars", /, *, seconds: float = 2.0, guidance: str = "", report: Path | None = None, json: Json = False
) -> int:
    """Run a rig, read its camera in a second process, as a driver does, and compare every event.

    The camera is on USB/IP or on GigE Vision; the latter is read by neuromorphic_drivers where that is installed. A
    report of the run and a movie of the first received events are written at the end. Events are judged, lateness is
    not: a machine that is slower than real time is mentioned.

    Parameters
    ----------
    rig
        Rig file or name of a shipped rig, with a usbip or gige link; or `landing`: one from 500 m, guided by events.
    seconds
        Time for which the second process reads, from the first event that is sent to it.
    guidance
        With `landing`: FILE.py:NAME, a guidance law of your own that flies in the place of evstim's.
    report
        Folder for the report and received.gif, or for the files of a landing. Default: a temporary one.
    """
    if rig == "landing":
        with failures():
            return fly_landing(guidance, report, as_json=json)
    with failures(), TemporaryFolder("demo-streams") as folder:
        if guidance:
            raise Failure(f"{rig} has no guidance: give --guidance with `evstim demo landing`", WRONG_USE)
        sent, received = Path(folder) / "sent.npz", Path(folder) / "received.npz"
        loaded = rig_with_options(_on_a_free_port(load_rig(rig)), seconds + 60, None, None)
        report = report or lasting_folder("demo")
        status.print(f"{loaded.name}: {loaded.title}")
        result = _run(loaded, Files(record=sent, report=report), received, seconds)
        verdict = _compare(sent, received, to_the_end=isinstance(loaded.links[0], UsbipLink))
        movie = _movie(received, report, loaded)
    good = verdict["equal"] is True and result.good
    value = {**summary(loaded, result), "comparison": verdict, "movie": movie, "report": report, "good": good}
    print_result(json, value, _verdict_lines(result, verdict, good))
    return GOOD if good else BAD_VERDICT


def _on_a_free_port(rig: Rig) -> Rig:
    """Return the rig with its camera alone, at an address that no program uses: drivers use one port of GigE Vision.

    The demo compares events: lateness is judged by `run`.
    """
    rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, max_late_ms=0.0))
    for link in rig.links:
        if isinstance(link, UsbipLink):
            return dataclasses.replace(rig, links=(dataclasses.replace(link, host="127.0.0.1", port=0),))
        if isinstance(link, GigeLink):
            alone = dataclasses.replace(link, host=free_loopback_address(GVCP_PORT), port=GVCP_PORT, allow=())
            return dataclasses.replace(rig, links=(alone,))
    raise Failure(f"{rig.name} has no usbip link and no gige link to attach to", WRONG_USE)


def _run(rig: Rig, files: Files, received: Path, seconds: float) -> RunResult:
    """Run until the receiver ends: it is stopped `seconds` after the first event that was sent to it."""
    link = rig.links[0]
    receiver: subprocess.Popen[bytes] | None = None
    end_s: float | None = None

    def follow(session: Session, now: RunStatus) -> None:
        nonlocal receiver, end_s
        report = now.links[link.name]
        if receiver is None:
            if report.address is not None:
                receiver = start_reader(link.kind, report.address, received)
        elif receiver.poll() is not None:
            session.stop()
        elif end_s is None:
            if report.delivered:
                end_s = time.monotonic() + seconds
        elif time.monotonic() > end_s:
            receiver.send_signal(signal.SIGINT)
            end_s = math.inf

    try:
        return run_with_files(rig, files, RunParts(follow=follow), show=False)[0]
    finally:
        if receiver is not None and receiver.poll() is None:
            receiver.kill()
            receiver.wait()


def _compare(sent: Path, received: Path, *, to_the_end: bool) -> dict[str, object]:
    """Compare, event by event, the delivered events since the last clock reset with the received ones.

    Over UDP, which has no end of stream, a reader that stops first has received the beginning of the stream.
    """
    delivered, resets = load_record(sent)
    delivered = delivered[resets[-1] :] if resets else delivered
    if not received.exists():
        return {"sent": len(delivered), "received": 0, "equal": False, "why": "the second process wrote no record"}
    arrived, _ = load_record(received)
    expected = delivered if to_the_end else delivered[: len(arrived)]
    equal = len(arrived) > 0 and np.array_equal(expected, arrived)
    return {"sent": len(delivered), "received": len(arrived), "equal": equal}


def _movie(received: Path, folder: Path, rig: Rig) -> Path | None:
    """Write a movie of the first received events, and print its path; None where there is none to write."""
    file = folder / "received.gif"
    show = PictureOptions(0.0, seconds=_MOVIE_S, fps=_MOVIE_FPS, size="x".join(map(str, rig.camera.size)))
    try:
        with failures():
            events, description = draw(str(received), file, show)
    except Failure as failure:
        console.print(f"no movie of the received events: {failure}", markup=False)
        return None
    console.print(f"movie: {file}, {events} received events {description}", markup=False)
    return file


def _verdict_lines(result: RunResult, verdict: dict[str, object], good: bool) -> Iterator[str]:
    rate, raised = result.frames / result.wall_seconds, result.ledger.raised
    slower = result.wall_seconds / result.sim_seconds if result.sim_seconds else math.inf
    late = f"; this machine was slower than real time by {slower:.2g}" if slower > _SLOWER else ""
    yield f"{result.sim_seconds:.1f} s of stream time, {rate:.0f} frames per second, {raised} events raised"
    yield f"{verdict['sent']} events sent since the last clock reset, {verdict['received']} received"
    yield f"all events are equal{late}" if verdict["equal"] else "THE STREAMS DIFFER"
    yield f"ledger: OFF BY {result.ledger.imbalance} EVENTS" if result.ledger.imbalance else "ledger: balanced"
    yield "good" if good else "NOT GOOD"
