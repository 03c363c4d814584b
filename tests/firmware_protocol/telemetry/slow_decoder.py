"""A decoder of event blocks written from docs/packets.md alone: plain Python, a string of bits, one event at a time.

It imports nothing of ours, so that both cannot share a mistake.
"""

TICKS = (1, 10, 100, 1000)
LAST = 2147483647


class Refused(Exception):
    """The block is malformed."""


def need(condition, why):
    if not condition:
        raise Refused(why)


class Bits:
    def __init__(self, data):
        self.text = "".join(f"{byte:08b}" for byte in data)
        self.at = 0

    def take(self, width):
        need(self.at + width <= len(self.text), "3: the payload ends before the last event")
        self.at += width
        return int(self.text[self.at - width : self.at] or "0", 2)

    def rice(self, k):
        """A value, or None where an escape follows."""
        ones = 0
        while ones < 16 and self.take(1):
            ones += 1
        return None if ones == 16 else ones << k | self.take(k)

    def parameter(self):
        k = self.take(8)
        need(k <= 27, "4: Rice parameter")
        return k

    def end(self):
        rest = self.text[self.at :]
        need(len(rest) < 8 and "1" not in rest, "3: the payload goes on")


def crc8(data):
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F) & 0xFF if crc & 0x80 else crc << 1
    return crc ^ 0xFF


def decode(data, near_us=0):
    """Return (header dict, list of records): events (t, x, y, p) or edges (t, kind, channel, seq)."""
    need(len(data) >= 14, "1: shorter than the header")
    need(data[0] >> 4 == 1 and crc8(data[:13]) == data[13], "1: version or CRC-8")
    mode, tick_code, polarity = data[0] & 15, data[1] >> 6, data[1] >> 4 & 3
    need(mode <= 3 and not data[1] & 15 and polarity != 1, "1: mode, reserved bits, polarity")
    need(not (mode in (0, 3) and polarity) and not (mode == 3 and tick_code), "1: polarity or tick of FLAT, EDGE")
    n = data[2] << 8 | data[3]
    need(n or mode == 0, "2: nothing")
    header = {
        "mode": ("FLAT", "ROWS", "BITMAP", "EDGE")[mode],
        "tick_us": TICKS[tick_code],
        "dropped": data[8] << 8 | data[9],
        "size": [(data[10] << 4 | data[11] >> 4) + 1, ((data[11] & 15) << 8 | data[12]) + 1],
    }
    low = int.from_bytes(data[4:8], "big")
    start = min((low + (near_us // 2**32 + i) * 2**32 for i in (-1, 0, 1)), key=lambda t: (abs(t - near_us), t))
    if start < 0:
        start += 2**32
    bits = Bits(data[14:])
    if mode == 3:
        return header, edges(bits, n, start)
    walk = Walk(bits, header["size"], header["tick_us"], polarity, n)
    (walk.flat, walk.rows, walk.bitmap)[mode]()
    bits.end()
    return header, [(start + t, x, y, p) for t, x, y, p in walk.events]


def edges(bits, n, start):
    records, last = [], 0
    for i in range(n):
        since, kind, channel, seq = bits.take(32), bits.take(8), bits.take(8), bits.take(16)
        need(last <= since <= LAST and (i or not since), "6: time of an edge")
        need(kind in (2, 3, 4), "7: kind")
        records.append((start + since, kind, channel, seq))
        last = since
    bits.end()
    return records


class Walk:
    """Where the decoder is in the raster, and what it has found."""

    def __init__(self, bits, size, tick, polarity, n):
        self.bits, (self.width, self.height), self.tick, self.polarity, self.n = bits, size, tick, polarity, n
        self.bx, self.by = (self.width - 1).bit_length(), (self.height - 1).bit_length()
        self.ticks = self.address = 0
        self.events = []

    def place(self):
        y, x = self.bits.take(self.by), self.bits.take(self.bx)
        need(x < self.width and y < self.height, "5: outside the array")
        return y * self.width + x

    def p(self):
        return self.bits.take(1) if self.polarity == 0 else self.polarity - 2

    def emit(self, p):
        need(len(self.events) < self.n, "5: more than n events")
        need(self.ticks * self.tick <= LAST, "6: span of time")
        self.events.append((self.ticks * self.tick, self.address % self.width, self.address // self.width, p))

    def flat(self):
        for i in range(self.n):
            ticks, address = self.bits.take(31 - self.by - self.bx), self.place()
            need(i or not ticks, "6: first event")
            need((ticks, address) >= (self.ticks, self.address), "6: goes back")
            self.ticks, self.address = ticks, address
            self.emit(self.bits.take(1))

    def step(self, k):
        step = self.bits.rice(k)
        if step is None:
            dt, address = self.bits.take(31), self.place()
            need(dt or address >= self.address, "6: goes back")
            self.ticks, self.address = self.ticks + dt, address
        else:
            s = self.address + step
            self.ticks += s // (self.width * self.height)
            self.address = s % (self.width * self.height)

    def rows(self):
        k = self.bits.parameter()
        self.address = self.place()
        self.emit(self.p())
        for _ in range(self.n - 1):
            self.step(k)
            self.emit(self.p())

    def bitmap(self):
        ks, kl = self.bits.parameter(), self.bits.parameter()
        self.address = self.place()
        self.span(kl)
        while len(self.events) < self.n:
            self.step(ks)
            self.span(kl)

    def span(self, kl):
        length = self.bits.rice(kl)
        need(length is not None, "4: length is an escape")
        length += 1
        need(self.address + length <= self.width * self.height, "5: a span passes the end")
        solid = self.bits.take(1) if length >= 3 else 0
        same = self.polarity == 0 and length >= 2 and self.bits.take(1)
        one_for_all = self.p() if same or self.polarity else None
        first, last = self.address, self.address + length - 1
        for self.address in range(first, last + 1):
            if self.address in (first, last) or solid or self.bits.take(1):
                self.emit(self.p() if one_for_all is None else one_for_all)
