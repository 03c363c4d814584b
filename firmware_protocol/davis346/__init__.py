"""Model of the DAVIS346 and of the DAVIS240C: the USB devices that a host sees."""

from firmware_protocol.davis346.biases import BIASES
from firmware_protocol.davis346.device import Davis240c, Davis240cSettings, Davis346, Davis346Settings
from firmware_protocol.davis346.model import DAVIS240C
from firmware_protocol.davis346.registers import Layout
from firmware_protocol.davis346.words import WordEncoder

__all__ = [
    "BIASES", "DAVIS240C", "Davis240c", "Davis240cSettings", "Davis346", "Davis346Settings", "Layout", "WordEncoder",
]  # fmt: skip
