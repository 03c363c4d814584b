"""Model of a DVXplorer (FX3): the USB device that a host sees."""

from firmware_protocol.dvxplorer.decoder import GroupDecoder
from firmware_protocol.dvxplorer.device import PRODUCT_ID, Dvxplorer, DvxplorerSettings
from firmware_protocol.dvxplorer.words import GroupEncoder

__all__ = ["PRODUCT_ID", "Dvxplorer", "DvxplorerSettings", "GroupDecoder", "GroupEncoder"]
