"""Vendor requests of a DAVIS346 in words, with the names of modules and registers; see `device` for the requests."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

from firmware_protocol.davis346.device import ENTRY, FLUSH, LOG_LEVEL, MULTI_WRITE, REGISTER
from firmware_protocol.davis346.registers import Layout, Module, SystemInfo, registers
from firmware_protocol.usb.device import RequestKind, SetupPacket
from firmware_protocol.usb.request_names import name_request

__all__ = ["name_answer", "name_davis_request"]

_SIZE = (346, 260)  # names do not depend on it
_MODULES = frozenset(map(int, Module))


def name_davis_request(setup: SetupPacket, data: bytes) -> str:
    """Return what a request asks of a DAVIS346; `data` are those of its OUT stage."""
    if setup.kind is not RequestKind.VENDOR:
        return name_request(setup, data)
    if setup.request == REGISTER and setup.is_in:
        return f"read {_name(setup.value, setup.index)}"
    if setup.request == REGISTER and len(data) == 4:
        return f"write {_name(setup.value, setup.index)} = {int.from_bytes(data, 'big')}"
    if setup.request == MULTI_WRITE and data and len(data) % ENTRY.size == 0:
        return f"write {', '.join(_entries(data))}"
    if setup.request == LOG_LEVEL:
        return f"log level {setup.value}"
    return "flush the data path" if setup.request == FLUSH else name_request(setup, data)


def name_answer(setup: SetupPacket, data: bytes) -> str:
    """Return what the answer to a request says; empty where that has no name."""
    if setup.kind is not RequestKind.VENDOR or setup.request != REGISTER or len(data) != 4:
        return ""
    return f"{_name(setup.value, setup.index)} = {int.from_bytes(data, 'big')}"


def _entries(data: bytes) -> Iterator[str]:
    for module, address, value in ENTRY.iter_unpack(data):
        yield f"{_name(module, address)} = {value}"


def _name(module: int, address: int) -> str:
    where = Module(module).name.lower() if module in _MODULES else f"module {module}"
    return f"{where}.{_names().get((module, address), 'parameter')} ({module}.{address})"


@cache
def _names() -> dict[tuple[int, int], str]:
    return {(r.module.value, r.address): r.name for r in registers(_SIZE, Layout.UPRIGHT, SystemInfo())}
