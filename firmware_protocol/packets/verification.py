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

from dataclasses import dataclass
from enum import IntEnum

from firmware_protocol.packets.ccsds import SpacePacket
from firmware_protocol.packets.errors import PacketError
from firmware_protocol.wire_layout import Field, Layout, WrongLength, choices_of

__all__ = [
    "FAILURE_LAYOUT",
    "LONGEST_TEXT",
    "REQUEST_LAYOUT",
    "CommandRefused",
    "Failure",
    "FailureCode",
    "RequestId",
    "Stage",
    "Verification",
]

LONGEST_TEXT = 80
"""Most characters of what was wrong."""


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


REQUEST_LAYOUT = Layout(
    Field("request_packet_id", 16, "version, type, flag and APID of the telecommand, as they came"),
    Field("request_sequence_control", 16, "sequence flags and count of the telecommand, as they came"),
)
"""Which telecommand."""
FAILURE_LAYOUT = Layout(Field("failure_code", 16, "why the telecommand failed", choices=choices_of(FailureCode)))
"""Why it failed; what was wrong follows as text."""


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
        return REQUEST_LAYOUT.pack(request_packet_id=self.packet_id, request_sequence_control=self.sequence_control)

    @classmethod
    def parse(cls, octets: bytes) -> RequestId:
        """Read four octets. Raises PacketError for any other number of them."""
        try:
            return cls(*REQUEST_LAYOUT.unpack(octets).values())
        except WrongLength as error:
            raise PacketError("request id") from error


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
        text = self.failure.text.encode("ascii", "replace")[:LONGEST_TEXT]
        return octets + FAILURE_LAYOUT.pack(failure_code=self.failure.code) + text

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
    if not FAILURE_LAYOUT.octets <= len(octets) <= FAILURE_LAYOUT.octets + LONGEST_TEXT:
        raise PacketError("length")
    code = FAILURE_LAYOUT.unpack(octets[: FAILURE_LAYOUT.octets])["failure_code"]
    try:
        return Failure(FailureCode(code), octets[FAILURE_LAYOUT.octets :].decode("ascii"))
    except ValueError as error:
        raise PacketError("failure notice") from error
