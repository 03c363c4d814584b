"""The baud rate, kept by ourselves: a pty takes bytes as fast as they are written, whatever rate it is set to.

    character   start bit, 5 to 8 data bits, parity bit or none, 1 to 2 stop bits       8N1: 10 bits a byte

A byte is on the line for its bits' time, one after the other. What is due is counted from an absolute start, so a late
tick sends what a real port's FIFO would have sent meanwhile, and the rate is exact however the ticks fall. A line that
had nothing to send starts afresh: it cannot make up for idle time.
"""

from __future__ import annotations

__all__ = ["BaudClock"]

_BEHIND_NS = 50_000_000  # the most that a late tick may catch up: what a driver's transmit buffer holds


class BaudClock:
    """When each byte has left, at `baud` bits a second and `bits` a byte.

    Parameters
    ----------
    bits
        Bits of a character on the line; may be half of one (1.5 stop bits).
    """

    def __init__(self, baud: int, bits: float) -> None:
        self._baud2 = 2 * baud
        self._half_bits = round(2 * bits)
        self._start_ns = 0
        self._sent = 0  # bytes since _start_ns
        self._began_ns: int | None = None
        self._carried = 0
        self._second = 0
        self._in_second = 0
        self._busiest = 0

    @property
    def bytes_per_s(self) -> float:
        """The line's capacity."""
        return self._baud2 / self._half_bits

    @property
    def carried(self) -> int:
        """Bytes that have left."""
        return self._carried

    @property
    def busiest_share(self) -> float:
        """Share of the line's time in the busiest whole second, 0 to 1."""
        return min(1.0, self._busiest / self.bytes_per_s)

    def share(self, now_ns: int) -> float:
        """Share of the line's time used since the first byte, 0 to 1."""
        if self._began_ns is None or now_ns <= self._began_ns:
            return 0.0
        return min(1.0, self._carried / self.bytes_per_s / ((now_ns - self._began_ns) * 1e-9))

    def free_ns(self) -> int:
        """When the line is free for the next byte."""
        return self._start_ns + self.duration_ns(self._sent)

    def duration_ns(self, count: int) -> int:
        """How long `count` bytes take, ns."""
        return count * self._half_bits * 1_000_000_000 // self._baud2

    def due(self, now_ns: int) -> int:
        """Bytes that may have left by now."""
        if now_ns - self.free_ns() > _BEHIND_NS:
            self.restart(now_ns - _BEHIND_NS)
        return max(0, (now_ns - self._start_ns) * self._baud2 // (self._half_bits * 1_000_000_000) - self._sent)

    def leave(self, count: int, now_ns: int) -> None:
        """Count `count` bytes, which were due, as having left."""
        if self._began_ns is None:
            self._began_ns = self.free_ns()
        self._sent += count
        self._carried += count
        second = now_ns // 1_000_000_000
        if second != self._second:
            self._second, self._in_second = second, 0
        self._in_second += count
        self._busiest = max(self._busiest, self._in_second)

    def restart(self, now_ns: int) -> None:
        """Say that the line stood still until now: it had nothing to send, or was held."""
        if now_ns > self.free_ns():
            self._start_ns, self._sent = now_ns, 0
