"""`evstim export KIND [RIG]`: definitions of the instrument's packets for ground systems."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Literal

from emulator.cli.checks import failures
from emulator.cli.output import GOOD, WRONG_USE, Json, failing, print_result
from emulator.rig.loading import load_rig
from firmware_protocol.can_frames.dbc import can_messages
from firmware_protocol.ground.cosmos import cosmos_files
from firmware_protocol.ground.description import instrument_packets
from firmware_protocol.ground.fprime import fprime_text
from firmware_protocol.ground.wireshark import wireshark_text
from firmware_protocol.ground.xtce import xtce_text
from transports.can_bus.kind import CanLink
from transports.link.kind import LinkParameters
from transports.udp_packets.kind import UdpPacketsLink


def export(
    kind: Literal["xtce", "cosmos", "fprime", "wireshark"],
    rig: str | None = None,
    /,
    *,
    out: Path = Path(),
    json: Json = False,
) -> int:
    """Write the definitions of the camera's packets for a ground system: see docs/packets.md.

    Parameters
    ----------
    kind
        xtce: XTCE 1.2, for Yamcs and others. cosmos: a plugin of OpenC3 COSMOS. fprime: a dictionary of F Prime's GDS.
        wireshark: a dissector in Lua.
    rig
        Path of a rig file, or the name of a shipped one: its UDP ports and CAN identifiers are used. Default: the
        default values of a link.
    out
        Folder for the files. Default: the current one.
    """
    links: tuple[LinkParameters, ...] = ()
    if rig is not None:
        with failures():
            links = tuple(load_rig(rig).links)
    udp = next((link for link in links if isinstance(link, UdpPacketsLink)), UdpPacketsLink())
    packets = instrument_packets()
    if kind == "xtce":
        files = {"evstim.xml": xtce_text(packets)}
    elif kind == "cosmos":
        plugin = cosmos_files(packets, udp.command_host, udp.command_port, udp.port)
        files = {f"openc3-cosmos-evstim/{name}": text for name, text in plugin.items()}
    elif kind == "fprime":
        files = {"EvstimTopologyDictionary.json": fprime_text(packets, version("evstim"))}
    else:
        can = next((link for link in links if isinstance(link, CanLink)), None)
        messages = () if can is None else can_messages(fd=can.fd, transport=can.carriage)
        frames = [] if can is None else [(can.identifiers.by_name[message.name], message) for message in messages]
        files = {"evstim.lua": wireshark_text(packets, (udp.port, udp.command_port), frames)}
    paths = [out / name for name in files]
    for path, text in zip(paths, files.values(), strict=True):
        with failing(WRONG_USE, OSError, at=str(path)):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    print_result(json, {"kind": kind, "files": paths}, map(str, paths))
    return GOOD
