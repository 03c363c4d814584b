"""Event telemetry for small computers: self-contained blocks of events or edges, described in docs/packets.md."""

from firmware_protocol.telemetry.layout import BlockError, Header, Mode, Polarity
from firmware_protocol.telemetry.reading import Block, as_received, decode_block
from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings

__all__ = [
    "Block",
    "BlockEncoder",
    "BlockError",
    "BlockSettings",
    "Header",
    "Mode",
    "Polarity",
    "as_received",
    "decode_block",
]
