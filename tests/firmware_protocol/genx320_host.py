"""A host of the GenX320 in a few lines; the sequences are those of OpenEB 5.1.1."""

from evk4_requests import DATA, Host, events_of

from firmware_protocol.genx320.device import Genx320, Genx320Settings

__all__ = ["DATA", "OPEN", "PROMPT", "START", "STOP", "Host", "events_of", "octets", "opened", "running"]

PROMPT = Genx320Settings(start_delay_us=0)
STOP = ((0x0000, 0x802), (0x002C, 0x20_0624), (0x9028, 2), (0x9008, 0x194), (0xB000, 0x1000_8804))
DESTROY = (
    (0x0070, 0x51C), (0xA004, 0x60_0054), (0xA008, 0x60_0084), (0x005C, 0x80), (0x005C, 0x80), (0xA01C, 0x13_601C),
    (0xA000, 0x4_0400), (0xB030, 0x13), (0xB00C, 0x102), (0xB030, 0x10), (0xB00C, 2), (0xA01C, 0x3_601C),
    (0x004C, 0x20_4E20), (0xB030, 0), (0xA01C, 0x3_601C), (0xA000, 0x400), (0x0204, 0xE75), (0x0204, 0xE74),
    (0x0214, 0x1_84A0),
)  # fmt: skip
INIT = (
    (0x001C, 1), (0xF004, 1), (0xF004, 0), (0xB010, 0), (0xB000, 0x1000_C003), (0x704C, 0x2710), (0x7100, 0xFFFF),
    (0x00B8, 0x20), (0x00C0, 0xB8), (0xB000, 0x1000_C003), (0xB000, 0x1000_8803), (0xB024, 0x8000_3E80),
    (0x1208, 0x30), (0x1104, 0x0101_0019), (0x1128, 0x0101_0019), (0x110C, 0x0101_0015), (0x1130, 0x0101_0014),
    (0x1000, 0x0301_003D), (0x1004, 0x0301_0022), (0x1008, 0x0101_003F), (0x1100, 0x0301_0028), (0x1104, 0x0101_0019),
    (0x1108, 0x0101_0033), (0x110C, 0x0101_001C), (0x1110, 0x0101_0039), (0x1114, 0x0309_000A), (0x1118, 0x0301_0038),
    (0x111C, 0x0300_0074), (0x1120, 0x0100_00A4), (0x1208, 0x35),
)  # fmt: skip
OPEN = (*STOP, *DESTROY, *INIT, (0x9008, 0x194))
START = ((0xB000, 0x1000_8803), (0x9028, 0), (0x9008, 0x195), (0x002C, 0x22_C724), (0x0000, 0xC02))


def opened(**changes):
    """Return a camera and its host after OpenEB's sequence of the opening."""
    camera = Genx320(Genx320Settings(**{"start_delay_us": 0, **changes}))
    host = Host(camera)
    host.write(*OPEN)
    return camera, host


def running(*entries, **changes):
    """Return a camera and its host after `entries` and OpenEB's sequence of the start."""
    camera, host = opened(**changes)
    host.write(*entries, *START)
    return camera, host


def octets(camera, max_bytes=131_072):
    """Take all that the camera sends."""
    pieces = []
    while (transfer := camera.read(DATA, max_bytes)) is not None:
        camera.sent(transfer)
        pieces.append(transfer.data)
    return b"".join(pieces)
