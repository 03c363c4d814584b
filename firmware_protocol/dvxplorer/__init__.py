"""Models of a DVXplorer (FX3) and of a DVXplorer Micro (CX3): the USB devices that a host sees."""

from firmware_protocol.dvxplorer.decoder import GroupDecoder
from firmware_protocol.dvxplorer.device import PRODUCT_ID, Dvxplorer, DvxplorerSettings
from firmware_protocol.dvxplorer.frame_words import FrameDecoder, FrameEncoder
from firmware_protocol.dvxplorer.micro import DvxplorerMicro, DvxplorerMicroSettings
from firmware_protocol.dvxplorer.words import GroupEncoder

__all__ = [
    "PRODUCT_ID",
    "Dvxplorer",
    "DvxplorerMicro",
    "DvxplorerMicroSettings",
    "DvxplorerSettings",
    "FrameDecoder",
    "FrameEncoder",
    "GroupDecoder",
    "GroupEncoder",
]
