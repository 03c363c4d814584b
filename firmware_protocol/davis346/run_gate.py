"""The run bits of a DAVIS346 as its data path sees them."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_protocol.davis346.registers import Module, RegisterFile

__all__ = ["RunGate"]


@dataclass(frozen=True)
class RunGate:
    """The run bits, as far as the data path cares."""

    timestamps: bool
    reset: bool
    words: bool
    events: bool

    @classmethod
    def of(cls, values: RegisterFile) -> RunGate:
        """Return what the registers say."""
        run, timestamps, reset, chip = (bool(values.read(Module.MULTIPLEXER, k)) for k in range(4))
        words = run and timestamps and chip and bool(values.read(Module.USB, 0))
        return cls(timestamps, reset, words, words and bool(values.read(Module.DVS, 3)))
