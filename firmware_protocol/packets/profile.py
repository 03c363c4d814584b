"""Profiles: a packet standard in a framing, by name.

    name          packets           framing                        for
    ccsds-cobs    PUS-C             COBS                           serial lines, the default
    ccsds-slip    PUS-C             SLIP                           serial lines
    ccsds-kiss    PUS-C             KISS with CRC-32C              serial lines
    csp-kiss      CSP version 2     KISS with CRC-32C              serial lines to libcsp
    fprime        PUS-C             F Prime, CRC-32                serial lines to F Prime
    ccsds         PUS-C             none                           transports of whole packets (ISO-TP)
    csp           CSP version 2     CRC-32C after each packet      transports of whole packets (CFP on CAN)

Telecommands by CSP may have a checksum that does not cover the header, as libcsp writes it when built without CSP_21:
their addresses are checked, and no other field of the header is used.

An instrument wraps messages and unwraps telecommands, the computer the other way round. A `Profile` holds the sequence
counts of the packets that it wrapped; each unwrapper holds those of the packets that it received.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

from firmware_protocol.framing import (
    DEFAULT_MAX_PAYLOAD,
    CobsDeframer,
    FPrimeDeframer,
    FrameCounters,
    KissDeframer,
    PacketDeframer,
    SealedPacketDeframer,
    SlipDeframer,
    StreamDeframer,
    cobs_frame,
    fprime_frame,
    kiss_frame,
    sealed,
    slip_frame,
)
from firmware_protocol.packets.addresses import (
    DEFAULT_ADDRESSES,
    Addresses,
    Message,
    PacketError,
    Received,
    SequenceFollower,
)
from firmware_protocol.packets.ccsds import SEQUENCE_MODULUS, Acknowledge
from firmware_protocol.packets.codec import CSP_HEADER_OCTETS, CspCodec, PacketCodec, PusCodec, Request
from firmware_protocol.packets.telecommands import CommandRefused, Failure, RequestId, Telecommand, parse_telecommand


@dataclass(frozen=True)
class _Make:
    """Parts of a profile."""

    codec: Callable[[Addresses], PacketCodec]
    frame: Callable[[bytes], bytes]
    deframer: Callable[[int], StreamDeframer]
    command_deframer: Callable[[int], StreamDeframer] | None = None
    """Deframer of telecommands, for profiles whose telecommands need another one."""


PROFILES: Mapping[str, _Make] = {
    "ccsds-cobs": _Make(PusCodec, cobs_frame, CobsDeframer),
    "ccsds-slip": _Make(PusCodec, slip_frame, SlipDeframer),
    "ccsds-kiss": _Make(PusCodec, kiss_frame, KissDeframer),
    "csp-kiss": _Make(CspCodec, kiss_frame, KissDeframer, partial(KissDeframer, header_bytes=CSP_HEADER_OCTETS)),
    "fprime": _Make(PusCodec, fprime_frame, FPrimeDeframer),
    "ccsds": _Make(PusCodec, bytes, PacketDeframer),
    "csp": _Make(CspCodec, sealed, SealedPacketDeframer, partial(SealedPacketDeframer, header_bytes=CSP_HEADER_OCTETS)),
}


@dataclass(frozen=True)
class ReceivedCommand:
    """A complete telecommand: decoded, or refused with the failure to report.

    Attributes
    ----------
    request : id that names it in a `Verification`.
    acknowledge : successes that its sender wants reported.
    command, failure : one of them is None.
    missing : telecommands that are missing before it.
    """

    request: RequestId
    acknowledge: Acknowledge
    command: Telecommand | None
    failure: Failure | None = None
    missing: int = 0


@dataclass
class UnwrapperCounters:
    """Counts of a receiver, by frames and packets: frames.frames = packets + idle + sum of refused.

    Attributes
    ----------
    frames : bytes and frames received.
    packets : good packets.
    idle : packets that fill the line.
    refused : refused packets of good frames, by reason.
    missing, disordered : see SequenceFollower.
    """

    frames: FrameCounters
    packets: int = 0
    idle: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    missing: int = 0
    disordered: int = 0


class _Receiver:
    """Common part of both directions: bytes to packets, and a check of their counts."""

    def __init__(self, codec: PacketCodec, deframer: StreamDeframer, modulus: int) -> None:
        self._codec = codec
        self._deframer = deframer
        self._follower = SequenceFollower(modulus)
        self.counters = UnwrapperCounters(deframer.counters)

    def _follow(self, counter: int, number: int) -> int:
        """Count a good packet; return the number of packets missing before it."""
        missing = self._follower.follow(counter, number)
        self.counters.packets += 1
        self.counters.missing = self._follower.missing
        self.counters.disordered = self._follower.disordered
        return missing


class Unwrapper(_Receiver):
    """Receiver of an instrument's bytes; returns its messages."""

    def push(self, data: bytes) -> list[Received]:
        """Process the next bytes; return the messages that they complete. Never raises; `counters` has the refused."""
        messages = []
        for octets in self._deframer.push(data):
            try:
                decoded = self._codec.decode(octets)
            except PacketError as error:
                self.counters.refused[str(error)] += 1
                continue
            if decoded is None:
                self.counters.idle += 1
                continue
            messages.append(Received(decoded.message, self._follow(decoded.counter, decoded.number)))
        return messages


class CommandUnwrapper(_Receiver):
    """Receiver of a computer's bytes; returns its telecommands."""

    def push(self, data: bytes) -> list[ReceivedCommand]:
        """Process the next bytes; return the telecommands that they complete.

        Never raises: damaged packets and those for other receivers are counted in `counters`; complete telecommands
        that are unknown or malformed are returned with the failure to report.
        """
        commands = []
        for octets in self._deframer.push(data):
            try:
                request = self._codec.decode_command(octets)
            except PacketError as error:
                self.counters.refused[str(error)] += 1
                continue
            commands.append(self._understood(request))
        return commands

    def _understood(self, request: Request) -> ReceivedCommand:
        missing = self._follow(request.id.packet_id, request.id.sequence_count)
        try:
            command = parse_telecommand(request.service, request.subtype, request.data)
        except CommandRefused as refusal:
            return ReceivedCommand(request.id, request.acknowledge, None, refusal.failure, missing)
        return ReceivedCommand(request.id, request.acknowledge, command, None, missing)


class Profile:
    """One side of a link: wraps its messages or telecommands, and makes receivers for those of the other side.

    Parameters
    ----------
    name : one of `PROFILES`. Raises ValueError for another.
    addresses : addresses of both sides; the same on both sides.
    max_payload : longest payload of a message in bytes; the same on both sides.
    """

    def __init__(
        self,
        name: str = "ccsds-cobs",
        addresses: Addresses = DEFAULT_ADDRESSES,
        max_payload: int = DEFAULT_MAX_PAYLOAD,
    ) -> None:
        if name not in PROFILES:
            raise ValueError(f"no profile {name!r}; there are {', '.join(PROFILES)}")
        self.name = name
        self.max_payload = max_payload
        self.last_request: RequestId | None = None
        """Id of the telecommand wrapped last."""
        self._make = PROFILES[name]
        self._addresses = addresses
        self._codec = self._make.codec(addresses)

    def wrap(self, message: Message) -> bytes:
        """Return the bytes that carry `message`. Raises ValueError when its payload is too long."""
        if len(message.payload) > self.max_payload:
            raise ValueError(f"a payload has at most {self.max_payload} bytes here, got {len(message.payload)}")
        return self._make.frame(self._codec.encode(message))

    def wrap_command(self, command: Telecommand, acknowledge: Acknowledge = Acknowledge.ALL) -> bytes:
        """Return the bytes that carry `command`; its id is then in `last_request`."""
        octets, self.last_request = self._codec.encode_command(command, acknowledge)
        return self._make.frame(octets)

    def unwrapper(self) -> Unwrapper:
        """Return a receiver of messages."""
        return Unwrapper(self._codec, self._make.deframer(self._max_packet), self._codec.sequence_modulus)

    def command_unwrapper(self) -> CommandUnwrapper:
        """Return a receiver of telecommands."""
        deframer = self._make.command_deframer or self._make.deframer
        return CommandUnwrapper(self._codec, deframer(self._max_packet), SEQUENCE_MODULUS)

    @property
    def _max_packet(self) -> int:
        return self.max_payload + self._codec.overhead_octets
