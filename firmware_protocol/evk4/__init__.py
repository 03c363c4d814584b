"""Model of the Prophesee EVK4 HD: the USB device that a host sees."""

from firmware_protocol.evk4.device import ANSWER_ENDPOINT, DATA_ENDPOINT, REQUEST_ENDPOINT, Evk4, Evk4Settings

__all__ = ["ANSWER_ENDPOINT", "DATA_ENDPOINT", "REQUEST_ENDPOINT", "Evk4", "Evk4Settings"]
