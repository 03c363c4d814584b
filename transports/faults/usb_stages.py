"""Faults at work on a device on USB: its endpoints, its control requests, and whether it is there at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from firmware_protocol.usb.device import NotReady, SetupPacket, Stall
from transports.faults.davis_kinds import RegisterFlip, WrongVersion
from transports.faults.hit_places import Places
from transports.faults.kinds import Fault
from transports.faults.usb_kinds import (
    ControlStall,
    EmptyTransfers,
    FifoOverflow,
    ShortTransfers,
    SlowControl,
    UsbSilence,
    UsbStall,
    UsbUnplugged,
)
from transports.faults.word_stages import WordStage, word_stage

__all__ = ["ControlStage", "UsbStage", "usb_stage"]


@dataclass
class UsbStage:
    """One fault at work on one IN endpoint, or on the whole device when it is `gone`; see `script.Stage`.

    Attributes
    ----------
    fault
        What was asked for.
    endpoint
        Number of the IN endpoint; that of the data where the camera's FIFO is to overflow.
    empty
        Which transfers come empty.
    overflow
        Events that the camera is to drop.
    """

    fault: Fault
    endpoint: int = 0
    silent: bool = False
    stalls: int = 0
    most_bytes: int = 0
    gone: bool = False
    empty: Places | None = None
    overflow: int = 0
    hits: int = 0
    touched: int = 0
    over: bool = False


class ControlStage(Protocol):
    """One fault at work on vendor requests; see `script.Stage` for the attributes."""

    hits: int
    touched: int
    over: bool

    def ask(self, setup: SetupPacket, now_us: int) -> None:
        """Raise Stall or NotReady for a vendor request that is to be refused, or answered later."""


class _Refusal:
    def __init__(self, fault: ControlStall) -> None:
        self._request, self._left = fault.request, fault.count
        self.hits = self.touched = 0
        self.over = False

    def ask(self, setup: SetupPacket, now_us: int) -> None:
        if self.over or self._request not in (-1, setup.request):
            return
        self._left -= 1
        self.hits += 1
        self.over = not self._left
        raise Stall(f"{setup} is refused, by a fault")


class _Slowness:
    def __init__(self, fault: SlowControl) -> None:
        self._delay_us = round(fault.delay_ms * 1000)
        self._asked: SetupPacket | None = None
        self._due_us = 0
        self.hits = self.touched = 0
        self.over = False

    def ask(self, setup: SetupPacket, now_us: int) -> None:
        if setup is not self._asked:  # the same bytes again, after a time-out, are another request
            self._asked, self._due_us = setup, now_us + self._delay_us
            self.hits += 1
        if now_us < self._due_us:
            raise NotReady
        self._asked = None


def usb_stage(
    fault: Fault, random: np.random.Generator, dropped: Callable[[], int] = lambda: 0
) -> UsbStage | WordStage | _Refusal | _Slowness:
    """Return what this fault does to a device on USB; raises ValueError for one that USB does not have.

    `dropped` gives the events that the camera has dropped for want of room.
    """
    words = word_stage(fault, random)
    if words is not None:
        return words
    match fault:
        case ControlStall():
            return _Refusal(fault)
        case SlowControl():
            return _Slowness(fault)
        case FifoOverflow():
            return UsbStage(fault, silent=True, overflow=dropped() + fault.events)
    return _endpoint_stage(fault, random)


def _endpoint_stage(fault: Fault, random: np.random.Generator) -> UsbStage:
    match fault:
        case UsbSilence():
            return UsbStage(fault, fault.endpoint, silent=True)
        case UsbStall():
            return UsbStage(fault, fault.endpoint, stalls=fault.count)
        case ShortTransfers():
            return UsbStage(fault, fault.endpoint, most_bytes=fault.most_bytes)
        case EmptyTransfers():
            return UsbStage(fault, fault.endpoint, empty=Places(fault, random))
        case UsbUnplugged():
            return UsbStage(fault, gone=True, hits=1)
        case WrongVersion():
            return UsbStage(fault, hits=1)
        case RegisterFlip():
            return UsbStage(fault)
    raise ValueError(f"{fault.kind!r} is no fault of a USB link")
