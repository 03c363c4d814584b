"""Parameters of a serial line, and its registration as a kind of link."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from firmware_protocol.bounds import check_bounds
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.network_streams.words import WORD_CONNECTION_CODERS
from transports.faults.kinds import FAULTS, SERIAL_LINE
from transports.link.kind import EVENT_OCTETS, CameraFacts, InstrumentLink, LinkKind, Listener, check_region, check_size

_PARITY_BITS = {"none": 0, "even": 1, "odd": 1, "mark": 1, "space": 1}


@dataclass(frozen=True)
class SerialLink(InstrumentLink):
    """Event telemetry, or a sensor's words, on a serial line: UART, RS-422, RS-485, or a pty for a program here.

    Attributes
    ----------
    port : "pty": a pair made for this run, whose other side is reported; or a device such as /dev/ttyUSB0; or any URL
        of pyserial (`socket://HOST:PORT`, `rfc2217://HOST:PORT`, `loop://`).
    symlink : with "pty": path of a symbolic link to the other side, the same for each run; "" for none.
    baud : bits a second; kept by the pacing of evstim if the port does not keep it.
    data_bits, parity, stop_bits
        Format of the character. Fewer than 8 data bits damage the telemetry: for tests of a receiver's reaction.
    flow : flow control, if the port supports it.
    rs485 : drive RTS as the transmitter's enable, if the port supports it.
    break_ms : length of a break sent before the first byte, if the port supports it; 0 for none.
    format : "telemetry": events, telecommands and housekeeping in packets. "evt2", "evt21", "evt3", "spif": words of a
        sensor alone, without faults; of `instrument` then region, keep_every, rate_limit and the queue are used.
    profile : packets and framing of the telemetry.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "serial"
    port: str = "pty"
    symlink: str = ""
    baud: Annotated[int, Meta(ge=50, le=50_000_000)] = 921_600
    data_bits: Literal[5, 6, 7, 8] = 8
    parity: Literal["none", "even", "odd", "mark", "space"] = "none"
    stop_bits: float = 1.0
    flow: Literal["none", "rts_cts"] = "none"
    rs485: bool = False
    break_ms: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    format: Literal["telemetry", "evt2", "evt21", "evt3", "spif"] = "telemetry"
    profile: Literal["ccsds-cobs", "ccsds-slip", "ccsds-kiss", "csp-kiss", "fprime"] = "ccsds-cobs"
    name: str = "serial"
    instrument: InstrumentSettings = field(default_factory=InstrumentSettings)

    def __post_init__(self) -> None:
        check_bounds(self)
        if not self.port:
            raise ValueError('port is empty; give "pty", a device such as /dev/ttyUSB0, or a URL')
        if self.stop_bits not in (1, 1.5, 2):
            raise ValueError(f"stop_bits must be 1, 1.5 or 2, got {self.stop_bits}")
        if self.symlink and self.port != "pty":
            raise ValueError(f'symlink is for port = "pty"; {self.port} has its own path')
        if self.sends_words and self.profile != SerialLink.profile:
            raise ValueError(f'profile is of the format "telemetry"; {self.format} has neither packets nor framing')
        if self.sends_words and self.instrument.tick_us != 1:
            raise ValueError(f"instrument.tick_us must be 1 with {self.format}, got {self.instrument.tick_us}")

    @property
    def sends_words(self) -> bool:
        """True if the line carries a sensor's words alone."""
        return self.format != "telemetry"

    def sends_evt(self) -> bool:
        """Return true if the format is one of EVT words."""
        return self.format.startswith("evt")

    def carries_hz(self, camera: CameraFacts) -> float:
        """Return the events a second that the line carries at its baud rate."""
        octets_per_s = self.baud / self.bits
        if self.sends_words:
            return min(octets_per_s / EVENT_OCTETS[self.format], self.instrument.rate_limit or math.inf)
        return self.instrument.carried_hz(8 * octets_per_s, camera.size)

    def impossible_faults(self) -> Collection[str]:
        """Leave out all faults of the line with words: their loss is known of messages alone."""
        return FAULTS.usable() if self.sends_words else ()

    @property
    def bits(self) -> float:
        """Bits of a character on the line: start, data, parity, stop."""
        return 1 + self.data_bits + _PARITY_BITS[self.parity] + self.stop_bits


def _check(line: SerialLink, camera: CameraFacts) -> None:
    """Raise Unsuitable for a region beyond the sensor, or a sensor beyond what the words can number."""
    check_region(line, camera)
    if line.sends_words:
        check_size(line.format, WORD_CONNECTION_CODERS[line.format].limit_px, camera)


SERIAL = LinkKind(
    SerialLink,
    serves="instrument",
    endpoint="transports.serial_line.endpoint:SerialFactory",
    carrier=SERIAL_LINE,
    listener=Listener("serial", "Read a camera on a serial line.", "emulator.cli.listen.packets:serial"),
    check=_check,
)
