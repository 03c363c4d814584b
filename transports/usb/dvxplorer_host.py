"""Driver of a DVXplorer (FX3) on any `UsbHost`; the order of its requests is that of `davis_host`.

Biases and chip are set to the values that dv-processing 2.0.4 writes. It was never run on a real camera.
"""

from __future__ import annotations

from firmware_protocol.dvxplorer.decoder import GroupDecoder
from firmware_protocol.dvxplorer.device import PRODUCT_ID
from firmware_protocol.dvxplorer.registers import Chip, registers
from firmware_protocol.fx3.registers import Access, Module
from transports.usb.davis_host import Entry, Fx3Host, WordDecoder
from transports.usb.host import StreamSettings

DVXPLORER_PRODUCT = PRODUCT_ID

_OFF, _STREAM = 0, 2
_STOP: tuple[Entry, ...] = (
    (Module.DVS, 3, 0),
    (Module.BIAS, Chip.MODE, _OFF),
    *((Module.IMU, address, 0) for address in (2, 3, 4)),
    (Module.EXTERNAL_INPUT, 0, 0),
    (Module.EXTERNAL_INPUT, 11, 0),
    (Module.MULTIPLEXER, 0, 0),
    (Module.MULTIPLEXER, 1, 0),
    (Module.USB, 0, 0),
    (Module.MULTIPLEXER, 3, 0),
)
_START: tuple[Entry, ...] = (
    (Module.USB, 0, 1),
    (Module.MULTIPLEXER, 1, 1),
    (Module.MULTIPLEXER, 0, 1),
    (Module.DVS, 3, 1),
    (Module.BIAS, Chip.MODE, _STREAM),
)


class DvxplorerHost(Fx3Host):
    """Driver of one DVXplorer; see `Fx3Host`."""

    model = "DVXplorer"
    family = "DVXplorer"
    product = DVXPLORER_PRODUCT
    firmware = 9
    patch = 4
    stop_writes = _STOP
    start_writes = _START

    def _new_decoder(self) -> WordDecoder:
        return GroupDecoder(self.info.size)

    def _configure(self, settings: StreamSettings) -> None:
        self.write_register(Module.MULTIPLEXER, 3, 1)  # the chip is out of reset before its registers are written
        for one in registers():
            if one.module is Module.BIAS and one.access is Access.READ_WRITE and one.address != Chip.MODE:
                self.write_register(one.module, one.address, one.default)
        self.write_register(Module.USB, 1, settings.early_packet_us * self.info.usb_clock_mhz)
