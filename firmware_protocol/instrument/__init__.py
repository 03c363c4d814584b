"""An event camera without USB: what it is told, what it says, and how it keeps to a narrow line."""

from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.outgoing import Outgoing
from firmware_protocol.instrument.settings import InstrumentSettings

__all__ = ["Instrument", "InstrumentSettings", "Outgoing"]
