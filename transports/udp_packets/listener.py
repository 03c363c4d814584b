"""A computer that takes an instrument's packets from datagrams until told to stop; may tell it something."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from firmware_protocol.packets.ccsds import whole_packets
from firmware_protocol.packets.telecommands import Telecommand
from transports.link.pacing import Clock
from transports.link.reception import Receiving, Reception
from transports.network.datagrams import DatagramInlet, DatagramOutlet
from transports.recording.record import Recorder

__all__ = ["Ports", "listen_udp"]

_LOOK_PERIOD_NS = 500_000
_RECEIVE_BUFFER = 1 << 22
_AT_A_TIME = 1024


@dataclass(frozen=True)
class Ports:
    """Where packets come in, and where the camera takes telecommands; `allow` as in a rig, for senders of packets."""

    host: str = "127.0.0.1"
    port: int = 10_015
    command_host: str = "127.0.0.1"
    command_port: int = 10_025
    allow: tuple[str, ...] = ()


def listen_udp(
    ports: Ports,
    goes_on: Callable[[Reception], bool],
    clock: Clock,
    recorder: Recorder | None = None,
    commands: Sequence[Telecommand] = (),
) -> Reception:
    """Open the port, tell `commands`, and read while `goes_on` says so, which is asked after each look.

    Raises OSError when the port cannot be had. Nobody tells that the camera is gone.
    """
    receiving = Receiving("ccsds", clock, recorder)
    inlet, outlet = DatagramInlet(ports.host, ports.port, ports.allow), None
    try:
        inlet.open(_RECEIVE_BUFFER)
        if commands:
            outlet = DatagramOutlet(ports.command_host, ports.command_port)
            outlet.open()
            for command in commands:
                outlet.send(receiving.receiver.wrap(command))
        while goes_on(receiving.now):
            for datagram in inlet.take(_AT_A_TIME):
                _take(receiving, datagram)
            clock.sleep_until(clock.now_ns() + _LOOK_PERIOD_NS)
    finally:
        inlet.close()
        if outlet is not None:
            outlet.close()
    return receiving.finish(gone=False)


def _take(receiving: Receiving, datagram: bytes) -> None:
    for packet in whole_packets(datagram):
        receiving.take(packet)
