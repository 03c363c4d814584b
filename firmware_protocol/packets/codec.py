"""What a packet standard does for a profile: messages and telecommands to packets and back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from firmware_protocol.packets.addresses import Message
from firmware_protocol.packets.pus import Acknowledge
from firmware_protocol.packets.telecommands import RequestId, Telecommand

__all__ = ["Decoded", "PacketCodec", "Request"]


@dataclass(frozen=True)
class Decoded:
    """A message, and its number under a counter."""

    message: Message
    counter: int
    number: int


@dataclass(frozen=True)
class Request:
    """A telecommand as it came, not yet understood."""

    id: RequestId
    service: int
    subtype: int
    data: bytes
    acknowledge: Acknowledge


class PacketCodec(ABC):
    """Writes and reads the packets of one instrument; keeps the counts of what it wrote."""

    overhead_octets: ClassVar[int]
    """Most octets that a packet has beside the payload."""
    sequence_modulus: ClassVar[int]
    """Where sequence counts begin anew."""

    @abstractmethod
    def encode(self, message: Message) -> bytes:
        """Return the packet of a message."""

    @abstractmethod
    def decode(self, octets: bytes) -> Decoded | None:
        """Read the packet of a message; None for a packet that says nothing. Raises PacketError for any other."""

    @abstractmethod
    def encode_command(self, command: Telecommand, acknowledge: Acknowledge) -> tuple[bytes, RequestId]:
        """Return the packet of a telecommand, and its request id."""

    @abstractmethod
    def decode_command(self, octets: bytes) -> Request:
        """Read the packet of a telecommand. Raises PacketError when it is damaged or not for us."""
