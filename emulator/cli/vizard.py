"""`evstim vizard RIG`: a camera for an unmodified Basilisk simulation."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

from cyclopts import Parameter

from emulator.cli.checks import failures
from emulator.cli.output import (
    BAD_VERDICT,
    GOOD,
    LACKING,
    WRONG_USE,
    Failure,
    Json,
    failing,
    parsed_address,
    print_result,
    status,
)
from emulator.cli.run import NO_FILES, Files, RunParts, rig_with_options, run_with_files, summary, summary_lines
from emulator.cli.run_summary import latency_text
from emulator.report.pictures import check_pillow, grey_png
from emulator.rig.loading import Rig, load_rig
from emulator.run.basilisk import BasiliskRun, camera_differs, connected
from emulator.run.outcome import RunResult, good, judge
from emulator.trajectory.live import GivenPath
from firmware_protocol.vizard import Update
from transports.link.deliveries import LatencySummary
from transports.link.pacing import MonotonicClock
from transports.needs import install_command
from transports.network import check_allow
from transports.vizard import ForwardingServer, Other, Server, VizardServer


@Parameter(name="*")
@dataclass(frozen=True)
class ConnectionOptions:
    """Address that the simulation connects to, and options of its images.

    Attributes
    ----------
    at
        HOST:PORT to listen on; in Basilisk these are reqComAddress and reqPortNumber.
    allow
        Addresses and networks that may connect; needed where HOST can be reached from other machines.
    forward
        HOST:PORT of a second visualiser that gets every request too: another evstim with its own camera, or Vizard.
    white
        Light that is white in the images, relative to the sensor's reference.
    """

    at: str = "127.0.0.1:5556"
    allow: Annotated[tuple[str, ...], Parameter(negative="")] = ()
    forward: str | None = None
    white: float = 1.0


def vizard(
    rig: str,
    /,
    *,
    seconds: float | None = None,
    seed: int | None = None,
    connection: ConnectionOptions = ConnectionOptions(),
    files: Files = NO_FILES,
    json: Json = False,
) -> int:
    """Run a rig in step with a Basilisk simulation: it gives poses and time, and gets images; the links get events.

    The run ends when the simulation does. See docs/loops.md.

    Parameters
    ----------
    rig
        Path of a rig file with paths of kind "basilisk", or the name of a shipped one.
    seconds
        Simulated time to run for; the simulation then ends with an error. Default: until it ends by itself.
    seed
        Seed of everything random. Default: the rig's.
    """
    with failures():
        for module in ("zmq", "google.protobuf"):
            with failing(LACKING, ImportError, at=f"this needs pyzmq and protobuf: {install_command('basilisk')}"):
                importlib.import_module(module)
        check_pillow()
        loaded, paths = connected(load_rig(rig))
        loaded = rig_with_options(loaded, seconds or 0.0, seed, None)
        with _server(connection) as server, _forwarding(server, connection) as source:
            status.print(f"Basilisk may connect to {server.address}", markup=False)
            simulation = _simulation(loaded, paths, source, connection)
            try:
                result, truth = run_with_files(loaded, files, RunParts(simulation=simulation), show=not json)
            finally:
                simulation.end("evstim has ended its run")
            counts = _basilisk_json(simulation, server)
    problems = _problems(simulation, result, seconds)
    if isinstance(source, ForwardingServer) and source.lost:
        problems.append(source.lost)
    outcome = {"truth_trouble": truth.trouble, "basilisk": counts, "problems": problems}
    lines = [*summary_lines(loaded, result, truth.trouble), *_lines(counts, problems)]
    print_result(json, {**summary(loaded, result), **outcome}, lines)
    return GOOD if good(judge(loaded.verdict, result)) and not (truth.trouble or problems) else BAD_VERDICT


@contextmanager
def _server(connection: ConnectionOptions) -> Iterator[VizardServer]:
    host, port = parsed_address("--at", connection.at, least_port=0)
    host = "127.0.0.1" if host == "localhost" else host
    if not connection.white > 0:
        raise Failure(f"--white is {connection.white:g}: it must be above 0", WRONG_USE)
    with failing(WRONG_USE, ValueError):
        check_allow(host, connection.allow, "--at")
    try:
        server = VizardServer(host, port, connection.allow)
    except OSError as error:
        raise Failure(f"--at: {error.strerror or error}; give another port, or end its program", LACKING) from error
    with closing(server):
        yield server


@contextmanager
def _forwarding(server: VizardServer, connection: ConnectionOptions) -> Iterator[Server]:
    """Yield the source of requests: the server itself, or one that forwards them to a second visualiser too."""
    if connection.forward is None:
        yield server
        return
    with failing(LACKING, OSError, at=f"--forward: start it first: no program listens on {connection.forward}"):
        other = Other(*parsed_address("--forward", connection.forward))
    with closing(other):
        yield ForwardingServer(server, other)


def _simulation(rig: Rig, paths: Sequence[GivenPath], server: Server, connection: ConnectionOptions) -> BasiliskRun:
    numbers = [driven.table.camera for driven in paths if driven.table.camera is not None]

    def greet(update: Update) -> None:
        status.print(f"Basilisk is here, at {update.time_ns * 1e-9:g} s of its time", markup=False)
        for difference in [camera_differs(rig, update.camera(number)) for number in numbers]:
            if difference:
                status.print(f"note: {difference}", markup=False)

    return BasiliskRun(server, paths, partial(grey_png, white=connection.white), MonotonicClock(), greet)


def _basilisk_json(simulation: BasiliskRun, server: VizardServer) -> dict[str, Any]:
    counters = simulation.counters
    times = {"first_ns": simulation.first_ns, "last_ns": simulation.last_ns}
    latencies = {"answer_us": counters.answer.summary(), "first_event_us": counters.first_event.summary()}
    counts = {name: value for name, value in vars(counters).items() if name not in ("answer", "first_event")}
    other = {"other_peers_refused": server.refused, "left": server.peer_gone}
    return {**times, **counts, **other, **{name: dataclasses.asdict(latency) for name, latency in latencies.items()}}


def _problems(simulation: BasiliskRun, result: RunResult, seconds: float | None) -> list[str]:
    counters = simulation.counters
    if simulation.first_ns is None:
        return ["no update came from Basilisk" + (f": {counters.last_refusal}" if counters.refused else "")]
    problems = []
    if counters.refused:
        problems.append(f"{counters.refused} requests refused, the last one because: {counters.last_refusal}")
    if seconds and result.sim_seconds < seconds:
        problems.append(f"the simulation ended after {result.sim_seconds:g} of {seconds:g} s")
    return problems


def _lines(counts: dict[str, Any], problems: Sequence[str]) -> Iterator[str]:
    yield (
        f"basilisk: {counts['updates']} updates, {counts['images']} images, {counts['no_images']} requests for other "
        f"cameras' images, {counts['other_peers_refused']} messages of other peers refused"
    )
    for event, name in (("first event handed to a link", "first_event_us"), ("reply", "answer_us")):
        if counts[name]["p50"] is not None:
            yield f"basilisk: update to {event} {latency_text(LatencySummary(**counts[name]))}"
    yield from (f"NOT GOOD: {problem}" for problem in problems)
