"""Model of the DAVIS346: the USB device that a host sees."""

from firmware_protocol.davis346.biases import BIASES
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.registers import Layout
from firmware_protocol.davis346.words import WordEncoder

__all__ = ["BIASES", "Davis346", "Davis346Settings", "Layout", "WordEncoder"]
