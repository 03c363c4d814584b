"""Which endpoint numbers a USB device controller gives, and how a camera gets the ones that its drivers know.

Drivers of cameras name endpoints by number; the controller chooses the numbers itself, in the order in which endpoints
are declared. Most count 1, 2, 3 ... in each direction. Where a number comes too early, an unused endpoint takes it:

    dummy_udc   IN 1 6 11 2    DAVIS346: 0x81, unused 0x86, unused 0x8B, 0x82
    others      IN 1 2         DAVIS346: 0x81, 0x82
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from firmware_protocol.usb.descriptors import Endpoint, Interface, TransferType

__all__ = ["with_spares"]

_IN = 0x80
_IN_ORDER = tuple(range(1, 16))
_BY_DRIVER = {"dummy_udc": ((1, 6, 11, 2), (2, 7, 12, 1))}  # bulk endpoints of dummy_hcd.c: IN, OUT


def with_spares(interface: Interface, controller: str) -> Interface:
    """Return an interface whose endpoints get their addresses at a controller, named as in /sys/class/udc.

    Raises ValueError where the controller cannot give one of them.
    """
    in_order, out_order = _BY_DRIVER.get(controller.partition(".")[0], (_IN_ORDER, _IN_ORDER))
    ins = _declared(interface.endpoints, [_IN | number for number in in_order], controller)
    outs = _declared(interface.endpoints, out_order, controller)
    return replace(interface, endpoints=(*ins, *outs))


def _declared(endpoints: Sequence[Endpoint], given: Sequence[int], controller: str) -> Iterator[Endpoint]:
    """Yield the endpoints of one direction in the order of the addresses that will be given, and unused ones."""
    wanted = {one.address: one for one in endpoints if one.address & _IN == given[0] & _IN}
    if missing := wanted.keys() - set(given):
        told = ", ".join(f"0x{address:02X}" for address in sorted(missing))
        raise ValueError(
            f"the USB device controller {controller} has no endpoint {told}, which drivers of this camera use"
        )
    packet = max(one.max_packet for one in endpoints)
    for address in given:
        if not wanted:
            return
        yield wanted.pop(address) if address in wanted else Endpoint(address, TransferType.BULK, packet)
