"""Endpoints get the addresses that drivers know, at controllers that count differently."""

import pytest

from firmware_protocol.davis346.device import Davis346Settings
from firmware_protocol.imx636.evk4 import Evk4Settings
from firmware_protocol.usb.descriptors import Endpoint, Interface, Speed, TransferType
from transports.usb.functionfs.files import with_spares

ORDER = {"dummy_udc.0": ((1, 6, 11, 2), (2, 7, 12, 1)), "fe980000.usb": (range(1, 16), range(1, 16))}
SPEEDS = (Speed.FULL, Speed.HIGH, Speed.SUPER)


def given(interface, controller):
    """Return the addresses that a controller gives, counting as its driver does."""
    ins, outs = (iter(numbers) for numbers in ORDER[controller])
    return [0x80 | next(ins) if one.address & 0x80 else next(outs) for one in interface.endpoints]


@pytest.mark.parametrize("controller", ORDER)
@pytest.mark.parametrize("settings", [Davis346Settings, Evk4Settings])
@pytest.mark.parametrize("speed", SPEEDS)
def test_each_endpoint_gets_its_own_address(controller, settings, speed):
    own = settings(speed=speed).descriptors().configuration.interfaces[0]
    arranged = with_spares(own, controller)
    assert [one.address for one in arranged.endpoints] == given(arranged, controller)
    assert set(own.endpoints) <= set(arranged.endpoints)


def test_a_davis346_needs_no_spare_endpoint_where_numbers_have_no_gaps():
    own = Davis346Settings().descriptors().configuration.interfaces[0]
    assert with_spares(own, "fe980000.usb") == own


def test_two_spare_ones_come_between_at_dummy_hcd():
    own = Davis346Settings().descriptors().configuration.interfaces[0]
    assert [one.address for one in with_spares(own, "dummy_udc.0").endpoints] == [0x81, 0x86, 0x8B, 0x82]


def test_an_address_that_a_controller_does_not_have_is_refused():
    own = Interface((Endpoint(0x83, TransferType.BULK, 64),))
    with pytest.raises(ValueError, match=r"dummy_udc\.0 has no endpoint 0x83"):
        with_spares(own, "dummy_udc.0")
