"""Driver of a DAVIS346 on any `UsbHost`."""

from __future__ import annotations

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.device import PRODUCT_ID
from firmware_protocol.davis346.registers import Layout, registers
from firmware_protocol.fx3.registers import Module, SystemInfo
from transports.usb.fx3_host import SOURCES_OFF, Entry, Fx3Host, WordDecoder

_STOP: tuple[Entry, ...] = ((Module.DVS, 3, 0), (Module.APS, 4, 0), *SOURCES_OFF)
_FILTERS_OFF: tuple[Entry, ...] = tuple((Module.DVS, address, 0) for address in (31, 33, 51, 61, 62))
_START: tuple[Entry, ...] = (
    (Module.MULTIPLEXER, 3, 1),
    (Module.USB, 0, 1),
    (Module.MULTIPLEXER, 1, 1),
    (Module.MULTIPLEXER, 0, 1),
    (Module.DVS, 3, 1),
)


class DavisHost(Fx3Host):
    """Driver of one DAVIS346; see `Fx3Host`."""

    model = "DAVIS346"
    family = "DAVIS"
    product = PRODUCT_ID
    firmware = 6
    patch = 1
    stop_writes = _STOP
    start_writes = _START

    def _new_decoder(self) -> WordDecoder:
        return Decoder(self.info.size, self.info.turned)

    def _configure(self) -> None:
        declared = registers(self.info.size, Layout.UPRIGHT, SystemInfo())
        chip = [(r.module, r.address, r.default) for r in declared if r.module is Module.BIAS]
        self.write_registers(chip)
        self.write_registers(_FILTERS_OFF)
