"""Drivers of a DAVIS346 and a DAVIS240C on any `UsbHost`."""

from __future__ import annotations

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.model import DAVIS240C, DAVIS346
from firmware_protocol.davis346.registers import Layout, registers
from firmware_protocol.fx3.registers import Module, SystemInfo
from transports.usb.fx3_host import SOURCES_OFF, Entry, Fx3Host, WordDecoder

_FILTERS_OFF: tuple[Entry, ...] = tuple((Module.DVS, address, 0) for address in (31, 33, 51, 61, 62))
_START: tuple[Entry, ...] = (
    (Module.MULTIPLEXER, 3, 1), (Module.USB, 0, 1), (Module.MULTIPLEXER, 1, 1), (Module.MULTIPLEXER, 0, 1),
    (Module.DVS, 3, 1),
)  # fmt: skip


class DavisHost(Fx3Host):
    """Driver of one DAVIS346; see `Fx3Host`."""

    model = "DAVIS346"
    family = "DAVIS"
    chip = DAVIS346
    product = DAVIS346.product_id
    firmware = 6
    patch = 1
    stop_writes = (Module.DVS, 3, 0), (Module.APS, 4, 0), *SOURCES_OFF
    start_writes = _START

    def _new_decoder(self) -> WordDecoder:
        return Decoder(self.info.size, self.info.turned, self.chip.sample_shift)

    def _configure(self) -> None:
        declared = registers(self.info.size, Layout.UPRIGHT, SystemInfo(), model=self.chip)
        chip = [(r.module, r.address, r.default) for r in declared if r.module is Module.BIAS]
        self.write_registers(chip)
        self.write_registers(_FILTERS_OFF)


class Davis240cHost(DavisHost):
    """Driver of one DAVIS240C; see `Fx3Host`."""

    model = "DAVIS240C"
    chip = DAVIS240C
    product = DAVIS240C.product_id
    firmware = 4
