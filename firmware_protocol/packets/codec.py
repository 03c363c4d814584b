"""Interface of a packet standard to a profile: messages and telecommands to packets and back."""

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
    """A telecommand as received, not yet interpreted."""

    id: RequestId
    service: int
    subtype: int
    data: bytes
    acknowledge: Acknowledge


class PacketCodec(ABC):
    """Encodes and decodes the packets of one instrument; holds the sequence counts of the packets it encoded."""

    overhead_octets: ClassVar[int]
    """Most octets of a packet beside the payload."""
    sequence_modulus: ClassVar[int]
    """Modulus of the sequence counts."""

    @abstractmethod
    def encode(self, message: Message) -> bytes:
        """Return the packet of a message."""

    @abstractmethod
    def decode(self, octets: bytes) -> Decoded | None:
        """Read the packet of a message; None for a packet without information. Raises PacketError for any other."""

    @abstractmethod
    def encode_command(self, command: Telecommand, acknowledge: Acknowledge) -> tuple[bytes, RequestId]:
        """Return the packet of a telecommand, and its request id."""

    @abstractmethod
    def decode_command(self, octets: bytes) -> Request:
        """Read the packet of a telecommand. Raises PacketError if it is damaged or for another receiver."""
