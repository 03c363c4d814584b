"""A slow and strict reader of a DVXplorer Micro's stream, word by word, from the description of the protocol alone.

It shares nothing with the package. `wrong` has all for which dv-processing 2.0.4 drops a frame, or libcaer starts anew.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class FrameReader:
    """What a driver gets: events in the order of the wire, the times of frames, and faults."""

    events: list[tuple[int, int, int, bool]] = field(default_factory=list)
    frames: list[int] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    ms: int | None = None
    now_us: int | None = None
    x: int | None = None
    sub_us: int | None = None
    groups: set[int] = field(default_factory=set)
    is_bare: bool = False

    def feed(self, data):
        """Read whole words."""
        if len(data) % 4:
            self.wrong.append(f"{len(data)} bytes")
        for k in range(0, len(data) - 3, 4):
            self.word(int.from_bytes(data[k : k + 4], "little"))
        return self

    def word(self, word):
        if word >> 31:
            self.pair(word)
        elif word >> 26 & 1:
            self.column(word & 0x3FF, word >> 11 & 0x3FF, bool(word >> 21 & 1))
        elif word >> 27 & 1:
            ms = word & 0x3FFFFF
            if self.ms is not None and (ms - self.ms) % (1 << 22) not in range(1, 1 << 21):
                self.wrong.append(f"{ms} ms after {self.ms}")
            self.ms = ms
        elif word:
            self.wrong.append(f"word {word:#010x}")

    def column(self, x, sub_us, first):
        if self.is_bare:
            self.wrong.append(f"nothing in column {self.x}")
        if x > 639 or sub_us > 999 or self.ms is None:
            self.wrong.append(f"column {x} at {sub_us} us of {self.ms} ms")
            return
        if first:
            now_us = 1000 * self.ms + sub_us
            if self.now_us is not None and now_us <= self.now_us:
                self.wrong.append(f"frame at {now_us} after {self.now_us}")
            self.now_us, self.sub_us = now_us, sub_us
            self.frames.append(now_us)
        elif self.x is None or x <= self.x or sub_us != self.sub_us:
            self.wrong.append(f"column {x} at {sub_us} after {self.x} at {self.sub_us}")
        self.x, self.groups, self.is_bare = x, set(), True

    def pair(self, word):
        self.is_bare = False
        first = word >> 18 & 0x3F
        second = first + (word >> 26 & 0x1F)
        halves = ((first, word >> 16 & 1, word & 0xFF), (second, word >> 17 & 1, word >> 8 & 0xFF))
        used = {group for group, _, mask in halves if mask}
        if not used or not used.isdisjoint(self.groups) or max(used) > 59:
            self.wrong.append(f"groups {used} beside {self.groups}")
        if second == first and halves[1][2] and halves[0][1] == halves[1][1]:
            self.wrong.append(f"group {first} twice with one polarity")
        self.groups |= used
        for group, off, mask in halves:
            for bit in range(8):
                if mask >> bit & 1:
                    assert self.now_us is not None
                    assert self.x is not None
                    self.events.append((self.now_us, self.x, 8 * group + bit, not off))
