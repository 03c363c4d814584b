"""URBs as Linux records them: records of usbmon in a pcap file, which Wireshark and tshark open.

File, 24 bytes: magic 0xA1B2C3D4, version 2.4, zone 0, accuracy 0, longest record, link type 220 (USB_LINUX_MMAPPED).
Then for each record 16 bytes: seconds, microseconds, bytes kept, bytes there were; and the record:

     0  u64  id            the same for the two records of a URB
     8  u8   type          'S' submitted by the host, 'C' completed
     9  u8   transfer      0 isochronous, 1 interrupt, 2 control, 3 bulk
    10  u8   endpoint      bit 7: IN
    11  u8   device        number on its bus
    12  u16  bus
    14  i8   no setup      0: the setup packet is there, else '-'
    15  i8   no data       0: data follow, else '<' (IN, submitted) or '>' (OUT, completed)
    16  i64  seconds
    24  i32  microseconds
    28  i32  status        0, or a negative errno; -115 (in progress) of a URB that is submitted
    32  u32  length        asked for, or moved
    36  u32  kept          bytes of data that follow
    40  u8[8]              the setup packet
    48  i32  interval      52 i32 start frame   56 u32 flags   60 u32 isochronous descriptors
    64  data

Little-endian. Sources: Documentation/usb/usbmon.rst of Linux (struct usbmon_packet), the pcap-savefile manual page,
and the list of link types of tcpdump.org.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

__all__ = ["FILE_HEADER", "IN_PROGRESS", "MOST_BYTES", "UrbRecord"]

MOST_BYTES = 262_144
"""Longest record; data beyond it are cut."""

IN_PROGRESS = -115

_LINK_TYPE = 220
_FILE = struct.Struct("<IHHiIII")
_PACKET = struct.Struct("<IIII")
_RECORD = struct.Struct("<QBBBBHbbqiiII8siiII")
_NO_SETUP = ord("-")
_CONTROL = 2

FILE_HEADER = _FILE.pack(0xA1B2C3D4, 2, 4, 0, 0, MOST_BYTES, _LINK_TYPE)


@dataclass(frozen=True)
class UrbRecord:
    """One of the two records of a URB.

    Attributes
    ----------
    t_us
        Unix time.
    devid
        Bus number and device number, as USB/IP has them: bus << 16 | device.
    length
        Bytes that were asked for ('S') or moved ('C').
    """

    urb: int
    t_us: int
    submitted: bool
    transfer_type: int
    endpoint: int
    is_in: bool
    devid: int
    status: int
    length: int
    setup: bytes = bytes(8)
    data: bytes = b""

    def __bytes__(self) -> bytes:
        data = self.data[: MOST_BYTES - _RECORD.size]
        seconds, us = divmod(self.t_us, 1_000_000)
        shown = self.submitted and self.transfer_type == _CONTROL
        header = _RECORD.pack(
            self.urb, ord("S" if self.submitted else "C"), self.transfer_type, self.endpoint | self.is_in << 7,
            self.devid & 0xFF, self.devid >> 16 & 0xFFFF, 0 if shown else _NO_SETUP,
            0 if data else ord("<" if self.is_in else ">"), seconds, us, self.status, self.length, len(data),
            self.setup if shown else bytes(8), 0, 0, 0x200 if self.is_in else 0, 0,
        )  # fmt: skip
        whole = _RECORD.size + len(self.data)
        return _PACKET.pack(seconds & 0xFFFFFFFF, us, _RECORD.size + len(data), whole) + header + data
