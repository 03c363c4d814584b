"""The Prophesee EVK4 HD as its host sees it on USB."""

from firmware_protocol.evk4.device import ANSWER_ENDPOINT, DATA_ENDPOINT, REQUEST_ENDPOINT, Evk4, Evk4Settings

__all__ = ["ANSWER_ENDPOINT", "DATA_ENDPOINT", "REQUEST_ENDPOINT", "Evk4", "Evk4Settings"]
