"""All registers of the Triton2 EVS as they are at power-on, and what hosts may write to them."""

from __future__ import annotations

from firmware_protocol.gige.bootstrap import Register, bootstrap
from firmware_protocol.gige.description import Description
from firmware_protocol.gige.evs_registers import ACQUISITION_START, ACQUISITION_STOP, evs_areas, evs_rules
from firmware_protocol.gige.gvsp import BLOCK_OCTETS
from firmware_protocol.gige.memory import Rule
from firmware_protocol.gige.settings import GigeSettings
from firmware_protocol.gige.standard_rules import action_areas, packet_size, standard_rules

__all__ = ["triton2_areas", "triton2_rules"]


def triton2_areas(settings: GigeSettings) -> dict[int, bytes]:
    """Return the areas of a camera's memory."""
    description = Description(settings.size)
    areas = {0: bootstrap(settings, description.location), description.address: description.octets}
    return areas | evs_areas(settings.size, BLOCK_OCTETS) | action_areas()


def triton2_rules(size: tuple[int, int]) -> dict[int, Rule]:
    """Return the rules; registers that order something keep zero."""
    rules = {**standard_rules(), **evs_rules(size), Register.PACKET_SIZE: packet_size}
    return rules | dict.fromkeys((ACQUISITION_START, ACQUISITION_STOP, Register.TIME_CONTROL), _nothing)


def _nothing(_: int) -> int:
    return 0
