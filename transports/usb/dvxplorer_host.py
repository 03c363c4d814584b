"""Drivers of a DVXplorer (FX3) and of a DVXplorer Micro (CX3) on any `UsbHost`; none was ever run on a real camera.

The order of a DVXplorer's requests is that of `fx3_host`; biases and chip are set to the values that dv-processing
2.0.4 writes.

The order of a Micro's is that of dv-processing 2.0.4 (firmware 10) and of libcaer 3.3.15 (firmware 9). Registers keep
their power-on values. A Micro has no reset of its time and no external input; an inertial sample, which comes without a
time, gets that of the last word.
"""

from __future__ import annotations

from firmware_protocol.dvxplorer.decoder import GroupDecoder
from firmware_protocol.dvxplorer.device import PRODUCT_ID
from firmware_protocol.dvxplorer.frame_stream import SAMPLE_BYTES, sample_of
from firmware_protocol.dvxplorer.frame_words import FrameDecoder
from firmware_protocol.dvxplorer.registers import SIZE, Chip, registers
from firmware_protocol.fx3.camera import VENDOR_ID
from firmware_protocol.fx3.registers import Access, Module
from firmware_protocol.imu_samples import ImuSamples
from transports.usb.fx3_host import ENABLE_IMU, SOURCES_OFF, Entry, Fx3Host, Fx3Info, WordDecoder
from transports.usb.host import BulkReader, StreamSettings, UnsuitableDevice, UsbHost

_OFF, _STREAM = 0, 2
_START: tuple[Entry, ...] = (
    (Module.USB, 0, 1), (Module.MULTIPLEXER, 1, 1), (Module.MULTIPLEXER, 0, 1), (Module.DVS, 3, 1),
    (Module.BIAS, Chip.MODE, _STREAM),
)  # fmt: skip


class DvxplorerHost(Fx3Host):
    """Driver of one DVXplorer; see `Fx3Host`."""

    model = "DVXplorer"
    family = "DVXplorer"
    product = PRODUCT_ID
    firmware = 9
    patch = 4
    stop_writes = (Module.DVS, 3, 0), (Module.BIAS, Chip.MODE, _OFF), *SOURCES_OFF
    start_writes = _START

    def _new_decoder(self) -> WordDecoder:
        return GroupDecoder(self.info.size)

    def _configure(self) -> None:
        self.write_register(Module.MULTIPLEXER, 3, 1)  # the chip is out of reset before its registers are written
        for register in registers():
            is_of_chip = register.module is Module.BIAS and register.address != Chip.MODE
            if is_of_chip and register.access is Access.READ_WRITE:
                self.write_register(register.module, register.address, register.default)


CX3 = 4
"""High byte of bcdDevice of a Micro."""

_LOG_LEVEL = 0xB1
_NEW_FIRMWARE = 10
_OLDEST_FIRMWARE = 8
_STREAM_ENDPOINT = 2
_SAMPLE_ENDPOINT = 1
_SAMPLE_TRANSFERS = 8
_OF_FIRMWARE_9: tuple[tuple[Entry, ...], tuple[Entry, ...]] = (
    ((Module.BIAS, Chip.MODE, _STREAM),),
    ((Module.BIAS, Chip.MODE, 0),),
)
_OF_FIRMWARE_10: tuple[tuple[Entry, ...], tuple[Entry, ...]] = (
    ((Module.DVS, 3, 1),),
    ((Module.DVS, 3, 0), *((Module.IMU, address, 0) for address in (2, 3, 4))),
)


class MicroHost(Fx3Host):
    """Driver of one DVXplorer Micro; see `Fx3Host`."""

    model = "DVXplorer Micro"
    family = "DVXplorer"
    product = PRODUCT_ID
    firmware = _OLDEST_FIRMWARE
    _samples: BulkReader | None = None

    def _identify(self) -> Fx3Info:
        identity = self._host.identity
        if (identity.vendor_id, identity.product_id, identity.bcd_device >> 8) != (VENDOR_ID, self.product, CX3):
            raise UnsuitableDevice(f"{identity.vendor_id:04x}:{identity.product_id:04x} is not a DVXplorer Micro")
        firmware = identity.bcd_device & 0xFF
        if firmware < self.firmware:
            raise UnsuitableDevice(f"the camera has firmware version {firmware}; at least {self.firmware} is needed")
        self._register_bytes = 8 if firmware >= _NEW_FIRMWARE else 4
        self.start_writes, self.stop_writes = _OF_FIRMWARE_10 if firmware >= _NEW_FIRMWARE else _OF_FIRMWARE_9
        serial = self._serial()
        size = self.read_register(Module.DVS, 0), self.read_register(Module.DVS, 1)
        if size != SIZE:
            raise UnsuitableDevice(f"the camera has {size[0]} x {size[1]} pixels, a DVXplorer {SIZE[0]} x {SIZE[1]}")
        return Fx3Info(
            serial, firmware, 0, 0, chip_id=0, usb_clock_mhz=0, size=size, turned=False, timestamp_master=True
        )

    def start(self, settings: StreamSettings | None = None) -> None:
        """Start the stream of events; the camera's time begins at zero, so no reset is needed."""
        settings = settings or StreamSettings()
        self.stop()
        self._tolerated(_LOG_LEVEL, value=4)
        self._flush()
        self._decoder = self._new_decoder()
        self._imu = []
        has_imu = settings.imu and self.info.firmware >= _NEW_FIRMWARE and self.read_register(Module.IMU, 0) != 0
        if has_imu:
            self._samples = self._host.stream(_SAMPLE_ENDPOINT, SAMPLE_BYTES, _SAMPLE_TRANSFERS)
        self._reader = self._host.stream(_STREAM_ENDPOINT, settings.transfer_bytes, settings.transfers)
        self._write_each(self.start_writes)
        if has_imu:
            self._write_each(ENABLE_IMU)

    def take_imu(self) -> ImuSamples:
        """Return the samples since the last call, (n,) IMU_SAMPLE, each with the time of the last word."""
        while self._samples is not None and (data := self._samples.read(0.0)) is not None:
            self._take_sample(data)
        return super().take_imu()

    def _take_sample(self, data: bytes) -> None:
        assert isinstance(self._decoder, FrameDecoder)
        sample = sample_of(data, self._decoder.time_us)
        if sample is not None:
            self._imu.append(sample)

    def _end_stream(self) -> None:
        super()._end_stream()
        samples, self._samples = self._samples, None
        for data in samples.close() if samples is not None else ():
            self._take_sample(data)

    def _new_decoder(self) -> WordDecoder:
        return FrameDecoder(SIZE)

    def _configure(self) -> None:
        """Keep the power-on values."""


def driver_of_model(host: UsbHost) -> Fx3Host:
    """Return the driver of a DVXplorer or of a Micro: both have one product number."""
    return MicroHost(host) if host.identity.bcd_device >> 8 == CX3 else DvxplorerHost(host)
