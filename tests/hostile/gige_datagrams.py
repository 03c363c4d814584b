"""Datagrams that nobody should send to a GigE Vision camera: no requests, damaged ones, and valid ones in any order."""

import struct

from firmware_protocol.gige.gvcp import Command, request
from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2_registers import (
    ACQUISITION_START,
    ACQUISITION_STOP,
    BIASES,
    COLUMNS,
    ROWS,
    Erc,
    Evs,
    Ptp,
)

__all__ = ["answer_limit", "hostile_datagram", "valid_request"]

_ADDRESSES = [
    *Register, *Erc, *Evs, *Ptp, ACQUISITION_START, ACQUISITION_STOP, *(bias.address for bias in BIASES.values()),
    *(address for one in (ROWS, COLUMNS) for address in (one.on, one.selector, one.size, one.offset, one.count)),
    0x8000_0000, 0x7FFF_FFFC, 0xFFFF_FFFC, 1, 0x0D3C,
]  # fmt: skip
_VALUES = [0, 1, 2, 3, 64, 576, 720, 1280, 1400, 9000, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF]
_SMALL = 12


def valid_request(draw):
    """Return a request that is well formed, for anything."""
    command = int(draw.choice(list(Command)))
    address, value = int(draw.choice(_ADDRESSES)), int(draw.choice(_VALUES))
    payload = {
        Command.READREG: lambda: struct.pack(">I", address) * int(draw.integers(1, 130)),
        Command.WRITEREG: lambda: struct.pack(">II", address, value) * int(draw.integers(1, 4)),
        Command.READMEM: lambda: struct.pack(">IHH", address, 0, int(draw.integers(0, 140)) * 4),
        Command.WRITEMEM: lambda: struct.pack(">II", address, value),
        Command.PACKETRESEND: lambda: struct.pack(">IIIQ", 0, *sorted(draw.integers(0, 99, 2).tolist()), value),
        Command.ACTION: lambda: struct.pack(">III", *draw.integers(0, 2, 3).tolist()),
        Command.FORCEIP: lambda: draw.bytes(56),
    }.get(Command(command), bytes)()
    flags = 0x11 if command == Command.PACKETRESEND else 1
    return request(command, int(draw.integers(1, 1 << 16)), payload, flags)


def hostile_datagram(draw):
    """Return noise, a valid request, or one that was cut, prolonged or damaged."""
    kind, data = int(draw.integers(0, 5)), bytearray(valid_request(draw))
    if kind == 0:
        return draw.bytes(int(draw.integers(0, 700)))
    if kind == 1:
        return bytes(data[: int(draw.integers(0, len(data) + 1))])
    if kind == 2:
        return bytes(data) + draw.bytes(int(draw.integers(1, 1400)))
    if kind == 3:
        for place in draw.integers(0, len(data), 3):
            data[place] = int(draw.integers(0, 256))
    return bytes(data)


def answer_limit(asked):
    """Return the most octets that the standard gives in answer to a datagram."""
    if len(asked) < 8:
        return 0
    command = int.from_bytes(asked[2:4], "big")
    if command == Command.DISCOVERY:
        return 256
    if command == Command.READREG:
        return max(8, len(asked))
    if command == Command.READMEM and len(asked) >= 16:
        return 12 + int.from_bytes(asked[14:16], "big")
    return _SMALL
