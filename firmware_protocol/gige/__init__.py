"""GigE Vision as bytes: control (GVCP), stream (GVSP), registers, and the Triton2 EVS that is made of them."""

from firmware_protocol.gige.settings import GigeSettings
from firmware_protocol.gige.triton2 import Triton2

__all__ = ["GigeSettings", "Triton2"]
