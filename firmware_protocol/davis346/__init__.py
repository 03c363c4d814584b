"""Model of the DAVIS346: the USB device that a host sees."""

from firmware_protocol.davis346.biases import BIASES, BiasDefinition, CoarseFine, ShiftedSource, Vdac
from firmware_protocol.davis346.decoder import SPECIAL_EVENT, Decoded, Decoder, WordFaults
from firmware_protocol.davis346.device import Davis346
from firmware_protocol.davis346.registers import Access, Layout, Module, Register, SystemInfo, registers
from firmware_protocol.davis346.settings import DATA_ENDPOINT, DEBUG_ENDPOINT, Davis346Settings
from firmware_protocol.davis346.words import Encoded, Special, WordEncoder, WordState

__all__ = [
    "BIASES",
    "DATA_ENDPOINT",
    "DEBUG_ENDPOINT",
    "SPECIAL_EVENT",
    "Access",
    "BiasDefinition",
    "CoarseFine",
    "Davis346",
    "Davis346Settings",
    "Decoded",
    "Decoder",
    "Encoded",
    "Layout",
    "Module",
    "Register",
    "ShiftedSource",
    "Special",
    "SystemInfo",
    "Vdac",
    "WordEncoder",
    "WordFaults",
    "WordState",
    "registers",
]
