"""Layouts that the pages draw are those of the code: registers, USB/IP, and the record of the digest."""

import re
import runpy
import struct
import zlib
from pathlib import Path

import numpy as np

from firmware_protocol.events import EVENT
from firmware_protocol.usb import usbip
from transports.link.deliveries import digest_of

DOCS = Path(__file__).parents[2] / "docs"
USB_PAGE = (DOCS / "cameras.md").read_text(encoding="utf-8")
CODES = {"u8": "B", "u16": "H", "u32": "I", "s32": "i", "u64": "Q"}


def test_the_list_of_registers_is_what_its_script_makes():
    script = runpy.run_path(str(DOCS / "make_registers.py"))
    assert script["FILE"].read_text(encoding="utf-8") == script["text"]()


def fields_of(column, heading):
    """Return (offset, struct code) of each field below a heading in a drawing of columns."""
    drawing = next(part for part in USB_PAGE.split("```") if heading in part)
    lines = drawing.splitlines()
    first = next(i for i, line in enumerate(lines) if line[column:].startswith(heading))
    found = []
    for line in lines[first + 1 :]:
        field = re.match(r" {0,3}(\d+) (?:([us]\d+) |\w+\[(\d+)\])", line[column:])
        if field is None and line[column : column + 4].strip():
            break
        if field:
            found.append((int(field[1]), CODES[field[2]] if field[2] else f"{field[3]}s"))
    return found


def as_drawn(fields, length):
    """Return the struct that has these fields at these places."""
    form, at = ">", 0
    for offset, code in fields:
        form, at = form + f"{offset - at}x" * (offset > at) + code, offset + struct.calcsize(">" + code)
    return form + f"{length - at}x" * (length > at)


def same(drawn, packer):
    """Say whether a drawn struct packs numbers as the code's does."""
    zeros = packer.unpack(bytes(packer.size))
    values = [bytes([n]) * 300 if isinstance(zero, bytes) else n for n, zero in enumerate(zeros, 1)]
    return struct.pack(drawn, *values) == packer.pack(*values)


def test_usbip_is_drawn_as_it_is_sent():
    shared = fields_of(0, "shared")
    column = {"CMD_SUBMIT": 34, "CMD_UNLINK": 60, "RET_UNLINK": 60, "RET_SUBMIT": 60}
    of = {name: as_drawn(shared + fields_of(at, name), usbip.URB_HEADER_BYTES) for name, at in column.items()}
    assert same(of["CMD_SUBMIT"], usbip.SUBMIT)
    assert same(of["CMD_UNLINK"], usbip.UNLINK)
    assert same(of["RET_SUBMIT"], usbip.SUBMITTED)
    assert same(of["RET_UNLINK"], usbip.UNLINKED)
    assert same(as_drawn(fields_of(0, "operation header"), 8), usbip.OP_HEADER)
    assert same(as_drawn(fields_of(29, "device record"), 312), usbip.RECORD)


def test_the_digest_is_what_the_page_says():
    text = " ".join((DOCS / "instrument.md").read_text(encoding="utf-8").split())
    said = re.search(r"CRC-32 \(that of zlib\) .* as records of (\d+) octets, little-endian: (.*?);", text)
    kinds, names = zip(*re.findall(r"(u\d+) (\w+)", said[2]), strict=True)
    record = struct.Struct("<" + "".join(CODES[kind] for kind in kinds))
    assert record.size == int(said[1])
    events = np.array([(2**40 + 5, 345, 259, True), (2**40 + 5, 0, 1, False), (2**40 + 9, 7, 7, True)], EVENT)
    octets = b"".join(record.pack(*(int(event[name]) for name in names)) for event in events)
    assert zlib.crc32(octets) == digest_of(events) == digest_of(events[1:], digest_of(events[:1]))
