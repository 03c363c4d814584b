"""Trace of a camera's USB cable during a run: as text, and as a file for Wireshark.

    connection --submitted, completed, unlinked--> queue (bounded) --thread--> FILE.txt
                                                                           +-> FILE.pcap

FILE.txt has requests by name, transfers by length, and unlinks. FILE.pcap has every byte, but no unlinks, which the
format of `usbmon` does not have.

The connection only writes to a queue. If the disk is slower than the cable, URBs are omitted and both files continue
after them; the text contains the number of missing URBs. If a file cannot be written any more, it ends there and the
other one continues.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from firmware_protocol.usb.control import name_request
from firmware_protocol.usb.device import SetupPacket, UsbDevice
from firmware_protocol.usb.usbip import FILE_HEADER, IN_PROGRESS, Submit, Unlink, UrbRecord, UrbStatus
from transports.output_file import OutputFile
from transports.usb.usbip.connection import Found


def both_files(path: Path) -> tuple[Path, Path]:
    """Return PATH.txt and PATH.pcap."""
    return path.with_name(f"{path.name}.txt"), path.with_name(f"{path.name}.pcap")


def trace_paths(path: Path) -> tuple[Path, Path]:
    """Return the files to write: those of `path`, or of PATH-restart1 and so on if they already have contents."""
    for restart in count():
        files = both_files(path if not restart else path.with_name(f"{path.name}-restart{restart}"))
        if not any(file.exists() and file.stat().st_size for file in files):
            return files
    raise AssertionError  # count() does not end


_CAPACITY_BYTES = 32 << 20
_CAPACITY_URBS = 100_000
_CLOSE_TIMEOUT_S = 10.0
_PERIOD_S = 0.05
_CONTROL, _BULK = 2, 3
_KINDS = ("isochronous", "interrupt", "control", "bulk")
_STATUS = {UrbStatus.OK: "ok", UrbStatus.STALL: "STALL", UrbStatus.UNLINKED: "taken back", -108: "device gone"}
_SHOWN_BYTES = 8
_CONFIGURATION = SetupPacket(0x80, 6, 0x0200, 0, 0xFFFF)
_ENDPOINT_DESCRIPTOR = 5
_KIND_OF_ATTRIBUTES = (2, 0, 3, 1)  # for control, isochronous, bulk, interrupt: usbmon numbers them differently


@dataclass(frozen=True)
class _Moment:
    """URB when it was submitted (`status` None) or completed."""

    t_ns: int
    urb: Submit
    status: int | None
    length: int
    data: bytes


@dataclass(frozen=True)
class _TakenBack:
    """URB when the host cancelled it."""

    t_ns: int
    seqnum: int
    found: Found
    data: bytes = b""


class UrbTrace:
    """Writer of the URBs of one camera; raises OSError if a file cannot be opened.

    Parameters
    ----------
    path : FILE of FILE.txt and FILE.pcap. If those already have contents, FILE-restart1 and so on are used.
    device : the camera, from which the descriptors are read.
    now_ns : unix time.
    capacity_bytes : number of bytes that may wait for the disk.
    """

    def __init__(
        self, path: Path, device: UsbDevice, now_ns: Callable[[], int], capacity_bytes: int = _CAPACITY_BYTES
    ) -> None:
        text, pcap = trace_paths(path)
        self._text, self._pcap = OutputFile(text, "USB trace"), OutputFile(pcap, "USB trace")
        self._now_ns = now_ns
        self._words = _Words(device, now_ns())
        self._capacity_bytes = capacity_bytes
        self._waiting: deque[_Moment | _TakenBack] = deque()
        self._waiting_bytes = 0
        self._missing = 0
        self.missing = 0
        self._closing, self._lock = threading.Event(), threading.Lock()
        self._pcap.write(FILE_HEADER, flush=True)
        self._text.write(self._words.head.encode(), flush=True)
        self._thread = threading.Thread(target=self._run, name="usb trace", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """Reason for incomplete files; empty if both are complete."""
        lost = f"USB trace: {self.missing} records are missing, the disk was too slow" if self.missing else ""
        return self._text.trouble or self._pcap.trouble or lost

    def submitted(self, urb: Submit) -> None:
        """Record that the host has submitted a URB."""
        self._put(_Moment(self._now_ns(), urb, None, urb.length, urb.data))

    def completed(self, urb: Submit, status: int, length: int, data: bytes = b"") -> None:
        """Record that a URB was answered, cancelled, or lost with its connection."""
        self._put(_Moment(self._now_ns(), urb, status, length, data))

    def unlinked(self, unlink: Unlink, state: Found) -> None:
        """Record that the host cancels a URB."""
        self._put(_TakenBack(self._now_ns(), unlink.victim, state))

    def close(self) -> None:
        """Write the waiting records, for some seconds at most, and close the files."""
        self._closing.set()
        self._thread.join(_CLOSE_TIMEOUT_S)

    def _put(self, moment: _Moment | _TakenBack) -> None:
        with self._lock:
            full = self._waiting_bytes + len(moment.data) > self._capacity_bytes
            if full or len(self._waiting) >= _CAPACITY_URBS:
                self._missing += 1
                self.missing += 1
                return
            self._waiting.append(moment)
            self._waiting_bytes += len(moment.data)

    def _run(self) -> None:
        while not self._closing.wait(_PERIOD_S):
            self._write_waiting()
        self._write_waiting()
        self._text.close()
        self._pcap.close()

    def _write_waiting(self) -> None:
        while True:
            with self._lock:
                batch, self._waiting = self._waiting, deque()
                missing, self._missing = self._missing, 0
            if not batch and not missing:
                return
            for moment in batch:
                if isinstance(moment, _Moment):
                    self._pcap.write(bytes(self._words.record(moment)))
                self._text.write(self._words.line(moment).encode())
            if missing:
                self._text.write(f"# {missing} records are missing here: the disk was too slow\n".encode())
            with self._lock:
                self._waiting_bytes -= sum(len(moment.data) for moment in batch)
            for file in (self._text, self._pcap):
                file.write(b"", flush=True)


class _Words:
    """Text and record of a URB."""

    def __init__(self, device: UsbDevice, begun_ns: int) -> None:
        camera = device.identity
        self._device = device
        self._types = transfer_types(device)
        self._begun_ns = begun_ns
        self.head = (
            f"# USB trace of {camera.vendor_id:04x}:{camera.product_id:04x}, "
            f"begun at {begun_ns / 1e9:.6f} s Unix time\n"
            "# s since then, S submitted, C completed, U cancelled by the host, number of the URB, transfer, what\n"
        )

    def record(self, moment: _Moment) -> UrbRecord:
        """Return the record of a pcap file."""
        urb = moment.urb
        return UrbRecord(
            urb.seqnum, moment.t_ns // 1000, moment.status is None, self._type(urb), urb.endpoint, urb.is_in,
            urb.devid, IN_PROGRESS if moment.status is None else moment.status, moment.length, urb.setup, moment.data,
        )  # fmt: skip

    def line(self, moment: _Moment | _TakenBack) -> str:
        """Return a line of text."""
        if isinstance(moment, _TakenBack):
            return f"{self._seconds(moment.t_ns)} U {moment.seqnum:6d} {'unlink':13s} of a URB {moment.found.value}\n"
        urb = moment.urb
        transfer = f"{_KINDS[self._type(urb)]} {'IN' if urb.is_in else 'OUT'}"
        text = self._submission(urb) if moment.status is None else self._completion(moment, moment.status)
        letter = "S" if moment.status is None else "C"
        return f"{self._seconds(moment.t_ns)} {letter} {urb.seqnum:6d} {transfer:13s} {text}\n"

    def _seconds(self, t_ns: int) -> str:
        return f"{(t_ns - self._begun_ns) / 1e9:13.6f}"

    def _type(self, urb: Submit) -> int:
        return _CONTROL if urb.endpoint == 0 else self._types.get(urb.endpoint | urb.is_in << 7, _BULK)

    def _submission(self, urb: Submit) -> str:
        if urb.endpoint:
            return f"endpoint {urb.endpoint | urb.is_in << 7:#04x}, {urb.length} bytes"
        setup = SetupPacket.parse(urb.setup)
        return self._device.name_request(setup, urb.data) or name_request(setup, urb.data)

    def _completion(self, moment: _Moment, status: int) -> str:
        status_text = _STATUS.get(status, f"status {status}")
        if status != UrbStatus.OK:
            return status_text
        name = ""
        if moment.urb.endpoint == 0:
            name = self._device.name_answer(SetupPacket.parse(moment.urb.setup), moment.data)
        start = moment.data[:_SHOWN_BYTES].hex(" ")
        ellipsis = " ..." if len(moment.data) > _SHOWN_BYTES else ""
        return f"{status_text}, {moment.length} bytes{': ' if name or start else ''}{name or start + ellipsis}"


def transfer_types(device: UsbDevice) -> dict[int, int]:
    """Return usbmon's transfer type of each endpoint (address with direction bit), from the device's descriptors."""
    data = device.control(_CONFIGURATION, b"")
    types = {}
    at = 0
    while at + 2 <= len(data) and data[at] >= 2:
        if data[at + 1] == _ENDPOINT_DESCRIPTOR and at + 4 <= len(data):
            types[data[at + 2]] = _KIND_OF_ATTRIBUTES[data[at + 3] & 3]
        at += data[at]
    return types
