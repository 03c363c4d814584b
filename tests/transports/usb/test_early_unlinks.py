"""Unlinks whose URBs are still to come: which are kept, across the end of the sequence numbers, and how many."""

from firmware_protocol.usb.usbip import Unlink
from transports.usb.usbip.connection import EarlyUnlinks


def unlink(victim):
    return Unlink(0, 0x10002, victim)


def test_only_a_urb_that_is_newer_than_all_is_waited_for():
    early = EarlyUnlinks(limit=8)
    early.submitted(10)
    assert [early.store(unlink(victim)) for victim in (9, 10, 11, 12)] == [False, False, True, True]
    assert early.submitted(11) == unlink(11)
    assert early.submitted(12) == unlink(12)


def test_a_urb_is_given_its_unlink_once():
    early = EarlyUnlinks(limit=8)
    assert early.store(unlink(1))
    assert early.submitted(1) == unlink(1)
    assert early.submitted(1) is None


def test_sequence_numbers_go_round():
    early = EarlyUnlinks(limit=8)
    early.submitted(0xFFFFFFFE)
    assert early.store(unlink(3))
    assert not early.store(unlink(0xFFFFFFF0))
    assert early.submitted(3) == unlink(3)


def test_no_more_wait_than_may():
    early = EarlyUnlinks(limit=2)
    early.submitted(1)
    assert [early.store(unlink(victim)) for victim in (2, 3, 4)] == [True, True, False]
