"""Service 1 of PUS-C: what became of a telecommand.

    u8   subtype: 1 accepted, 2 not accepted, 3 started, 4 not started, 7 completed, 8 not completed
    u16  packet id of the telecommand          (its first four octets, as they came: version, type,
    u16  sequence control of the telecommand    flag, APID, sequence flags and count)
    failures only:
    u16  code, see `FailureCode`
    ...  what was wrong, ASCII, at most 80 characters

In a PUS packet the subtype is that of the packet, and the rest is its source data; elsewhere the octets stand as drawn.

Source: ECSS-E-ST-70-41C, clause 8.1; failure codes 0 to 5 are those of ECSS-E-70-41A, clause 6 (41C leaves them to the
mission), the others ours.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from firmware_protocol.packets.ccsds import SpacePacket
from firmware_protocol.packets.errors import PacketError

__all__ = ["CommandRefused", "Failure", "FailureCode", "RequestId", "Stage", "Verification"]

_REQUEST = struct.Struct(">HH")
_CODE = struct.Struct(">H")
_LONGEST_TEXT = 80


class Stage(IntEnum):
    """How far a telecommand got; the value is the subtype of its success, one more that of its failure."""

    ACCEPTANCE = 1
    START = 3
    COMPLETION = 7


class FailureCode(IntEnum):
    """Why a telecommand failed."""

    ILLEGAL_APID = 0
    LENGTH = 1
    CHECKSUM = 2
    ILLEGAL_SERVICE = 3
    ILLEGAL_SUBTYPE = 4
    ILLEGAL_DATA = 5
    NOT_NOW = 6
    NOT_SUPPORTED = 7


@dataclass(frozen=True)
class Failure:
    """Why a telecommand failed, as a number for programs and a text for people."""

    code: FailureCode
    text: str = ""


class CommandRefused(ValueError):
    """A telecommand cannot be taken."""

    def __init__(self, code: FailureCode, text: str) -> None:
        super().__init__(text)
        self.failure = Failure(code, text)


@dataclass(frozen=True)
class RequestId:
    """Which telecommand: the first four octets of its packet."""

    packet_id: int
    sequence_control: int

    @property
    def sequence_count(self) -> int:
        """Its sequence count."""
        return self.sequence_control & 0x3FFF

    @classmethod
    def of(cls, packet: SpacePacket) -> RequestId:
        """Return the id of the telecommand in a packet."""
        return cls(packet.packet_id, packet.sequence_control)

    def __bytes__(self) -> bytes:
        return _REQUEST.pack(self.packet_id, self.sequence_control)

    @classmethod
    def parse(cls, octets: bytes) -> RequestId:
        """Read four octets. Raises PacketError for any other number of them."""
        if len(octets) != _REQUEST.size:
            raise PacketError("request id")
        return cls(*_REQUEST.unpack(octets))


@dataclass(frozen=True)
class Verification:
    """One report: the telecommand got through the stage, or failed there."""

    stage: Stage
    request: RequestId
    failure: Failure | None = None

    @property
    def subtype(self) -> int:
        """Subtype under service 1."""
        return self.stage + (self.failure is not None)

    def encode(self) -> bytes:
        """Return the octets drawn above."""
        octets = bytes([self.subtype]) + bytes(self.request)
        if self.failure is None:
            return octets
        text = self.failure.text.encode("ascii", "replace")[:_LONGEST_TEXT]
        return octets + _CODE.pack(self.failure.code) + text

    @classmethod
    def parse(cls, payload: bytes) -> Verification:
        """Undo `encode`. Raises PacketError for anything that it does not write."""
        if not payload or payload[0] not in _SUBTYPES:
            raise PacketError("subtype")
        stage, failed = _SUBTYPES[payload[0]]
        request, rest = RequestId.parse(payload[1:5]), payload[5:]
        if not failed:
            if rest:
                raise PacketError("length")
            return cls(stage, request)
        return cls(stage, request, _parse_failure(rest))


_SUBTYPES = {stage + failed: (stage, bool(failed)) for stage in Stage for failed in (0, 1)}


def _parse_failure(octets: bytes) -> Failure:
    if not _CODE.size <= len(octets) <= _CODE.size + _LONGEST_TEXT:
        raise PacketError("length")
    (code,) = _CODE.unpack_from(octets)
    try:
        return Failure(FailureCode(code), octets[_CODE.size :].decode("ascii"))
    except ValueError as error:
        raise PacketError("failure notice") from error
