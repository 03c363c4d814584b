"""USB device model of a DAVIS346, and the names of its requests; `fx3` describes the requests and the run gate."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache

from firmware_protocol.davis346.biases import BIASES, sensor_factors
from firmware_protocol.davis346.filters import DvsFilters, Statistics
from firmware_protocol.davis346.fx3 import ENTRY, FLUSH, LOG_LEVEL, MULTI_WRITE, REGISTER, Fx3Camera, Parts
from firmware_protocol.davis346.inputs import DavisReadings
from firmware_protocol.davis346.registers import Layout, Module, SystemInfo, registers
from firmware_protocol.davis346.settings import Davis346Settings
from firmware_protocol.davis346.stream import EventStream, Fifo
from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.usb.control import name_request
from firmware_protocol.usb.device import RequestKind, SetupPacket


class Davis346(Fx3Camera):
    """The camera. `offer` takes events, `advance` the passing of stream time; the other methods are the USB side."""

    settings: Davis346Settings

    def __init__(self, settings: Davis346Settings | None = None) -> None:
        super().__init__(settings or Davis346Settings())

    def _make_parts(self) -> Parts:
        own = self.settings
        stream = EventStream(WordEncoder(own.size, own.layout.turned), Fifo(own.fifo_bytes))
        filters = DvsFilters(own.size, self._fates, has_activity=own.activity_filter)
        readings = DavisReadings(own, self._registers, self._fates)
        return Parts(stream, filters, readings, Statistics(self, stream, filters))

    def _factors_of_biases(self) -> Mapping[str, float]:
        return sensor_factors({bias.address: self._registers.read(Module.BIAS, bias.address) for bias in BIASES})


_SIZE = (346, 260)  # names do not depend on it
_MODULES = frozenset(map(int, Module))


def name_davis_request(setup: SetupPacket, data: bytes) -> str:
    """Return a request to a DAVIS346 in words; `data` are those of its OUT stage."""
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
    """Return the answer to a request in words; empty if it has no name."""
    if setup.kind is not RequestKind.VENDOR or setup.request != REGISTER or len(data) != 4:
        return ""
    return f"{_name(setup.value, setup.index)} = {int.from_bytes(data, 'big')}"


def _entries(data: bytes) -> Iterator[str]:
    for module, address, value in ENTRY.iter_unpack(data):
        yield f"{_name(module, address)} = {value}"


def _name(module: int, address: int) -> str:
    module_name = Module(module).name.lower() if module in _MODULES else f"module {module}"
    return f"{module_name}.{_names().get((module, address), 'parameter')} ({module}.{address})"


@cache
def _names() -> dict[tuple[int, int], str]:
    return {(r.module.value, r.address): r.name for r in registers(_SIZE, Layout.UPRIGHT, SystemInfo())}
