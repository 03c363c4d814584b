"""`evstim listen can` and `evstim dbc`: the receiving side of a CAN link."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from emulator.cli.checks import failures, prepared
from emulator.cli.listen import NO_LIMITS, Limits, Source, listen_to
from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, Json, RigName, console, failing, status
from emulator.cli.run_summary import latency_text
from emulator.rig.loading import Rig, load_rig
from emulator.run.kernels import DECODER
from firmware_protocol.can_frames.dbc import dbc_text
from transports.can_bus.bus import BusDown
from transports.can_bus.kind import CanLink
from transports.can_bus.node import CanReception, listen_can, peer_of
from transports.link.pacing import MonotonicClock
from transports.recording.record import Recorder

_GONE = "the bus went away, and the camera's heartbeat had not reported a stop: its run died"


def can(
    rig: str = "can-demo",
    /,
    *,
    link: str | None = None,
    interface: str | None = None,
    channel: str | None = None,
    limits: Limits = NO_LIMITS,
    json: Json = False,
) -> int:
    """Join the CAN bus of a rig, decode the telemetry of its camera, and count the losses. Ctrl-C ends it.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one: gives identifiers, bus and transport protocol.
    link
        Name of the CAN link. Default: the first one.
    interface
        Interface of python-can. Default: the rig's.
    channel
        Channel of that interface. Default: the rig's.
    """
    limits.check()
    with failures():
        parameters = peer_of(_link(load_rig(rig), link))
    interface, channel = interface or parameters.interface, channel or parameters.channel
    parameters = dataclasses.replace(parameters, interface=interface, channel=channel)
    prepared([DECODER])
    status.print(f"CAN bus {parameters.channel} by {parameters.interface}, {parameters.bitrate} bit/s")

    def receive(goes_on: Callable[[CanReception], bool], recorder: Recorder | None) -> CanReception:
        with failing(LACKING, BusDown):
            return asyncio.run(listen_can(parameters, goes_on, MonotonicClock(), recorder))

    return listen_to(Source(receive, _summary, _GONE), limits, json=json)


def _summary(reception: CanReception) -> list[str]:
    lines = [f", {reception.faults} faults{', the bus ended' if reception.gone else ''}"]
    if reception.jitter_us.p50 is not None:
        lines.append(f"delay above the shortest: {latency_text(reception.jitter_us)}")
    return lines + [f"{name}: {count}" for name, count in reception.counts.items()]


def dbc(
    rig: RigName, /, *, link: str | None = None, output: Annotated[Path | None, Parameter(alias="-o")] = None
) -> int:
    """Write the DBC file of a rig's CAN link: its identifiers and the layouts of its frames.

    Parameters
    ----------
    link
        Name of the CAN link. Default: the first one.
    output
        File to write. Default: stdout.
    """
    with failures():
        parameters = _link(load_rig(rig), link)
    text = dbc_text(parameters.identifiers, fd=parameters.fd, transport=parameters.carriage)
    if output is None:
        console.print(text, end="", markup=False)
        return GOOD
    with failing(WRONG_USE, OSError, at=str(output)):
        output.write_text(text, encoding="ascii")
    return GOOD


def _link(rig: Rig, name: str | None) -> CanLink:
    links = [rig_link for rig_link in rig.links if isinstance(rig_link, CanLink) and name in (None, rig_link.name)]
    if not links:
        raise Failure(f"{rig.name} has no CAN link{f' {name!r}' if name else ''}", WRONG_USE)
    return links[0]
