"""A slow reader of a DVXplorer's stream, word by word, from the description of the protocol alone.

It shares nothing with the package: rules and numbers are written out again, as libcaer's users know them.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Reader:
    """What a driver gets: events and marks with their times, samples as bytes, resets, and words without a meaning."""

    events: list[tuple[int, int, int, bool]] = field(default_factory=list)
    marks: list[tuple[int, int]] = field(default_factory=list)
    samples: list[tuple[int, int, bytes]] = field(default_factory=list)
    scans: list[int] = field(default_factory=list)
    resets: int = 0
    wrong: list[str] = field(default_factory=list)
    now_us: int = 0
    base_us: int = 0
    x: int | None = None
    first: int | None = None
    second: int | None = None
    sample: bytearray | None = None
    scale: int | None = None
    last_was_time: bool = False

    def feed(self, data):
        """Read whole words."""
        assert len(data) % 2 == 0
        for k in range(0, len(data), 2):
            self.word(data[k] | data[k + 1] << 8)

    def word(self, word):
        if word & 0x8000:
            self.time(self.base_us + (word & 0x7FFF))
            return
        code, value = word >> 12, word & 0xFFF
        if code == 7:
            self.base_us += value * 0x8000
            self.time(self.base_us)
        elif code == 0:
            self.special(value)
        elif code == 1:
            self.x = value & 0x3FF
            if self.x >= 640 or value & 0x400:
                self.wrong.append(f"column {value:#x}")
            if value & 0x800:
                self.scans.append(len(self.events))
        elif code == 4:
            self.first = value & 0x3F
            far = value >> 6 & 0x1F
            self.second = self.first - far if value & 0x800 else self.first + far
            if not (self.first < 60 and 0 <= self.second < 60):
                self.wrong.append(f"groups {value:#x}")
        elif code in (2, 3):
            self.pixels(self.first if code == 3 else self.second, value)
        elif code == 5:
            self.misc(value >> 8, value & 0xFF)
        else:
            self.wrong.append(f"word {word:#06x}")

    def time(self, t_us):
        if t_us < self.now_us or (t_us == self.now_us and t_us):
            self.wrong.append(f"time {t_us} after {self.now_us}")
        self.now_us = t_us

    def pixels(self, group, value):
        if self.x is None or group is None or value & 0xE00 or not value & 0xFF:
            self.wrong.append(f"pixels {value:#x} at column {self.x}, group {group}")
        if self.x is None or group is None:  # the three bits without a meaning are ignored
            return
        for bit in range(8):
            if value >> bit & 1:
                self.events.append((self.now_us, self.x, 8 * group + bit, not value & 0x100))

    def special(self, code):
        if code == 1:
            self.resets += 1
            self.now_us = self.base_us = 0
        elif code in (2, 3, 4, 16, 17):
            self.marks.append((self.now_us, code))
        elif code == 5 and self.sample is None:
            self.sample, self.scale = bytearray(), None
        elif code == 7 and self.sample is not None and self.scale is not None:
            self.samples.append((self.now_us, self.scale, bytes(self.sample)))
            self.sample = None
        else:
            self.wrong.append(f"special {code}")

    def misc(self, code, value):
        if self.sample is None or code not in (0, 3):
            self.wrong.append(f"misc {code}")
        elif code == 3:
            self.scale = value
        else:
            self.sample.append(value)


def read(data):
    """Return what a new reader finds in a whole stream."""
    reader = Reader()
    reader.feed(data)
    return reader
