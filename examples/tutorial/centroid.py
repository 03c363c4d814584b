"""The tutorial's flight code: the centroid of an asteroid's events, on a line that can be lost.

python centroid.py PORT
"""

from __future__ import annotations

import sys
import time

import serial

from evstim import SerialReceiver

WINDOW_US = 100_000
STALE_S = 0.5
MIN_EVENTS = 1000  # a line that opens within a window gives its last events only: their mean may be anywhere


class Centroid:
    """The mean position of the events of each 100 ms.

    Attributes
    ----------
    x, y : pixels, of the last window with enough events.
    is_fresh : False when there was no such window in the last half second, or the line is lost.
    """

    def __init__(self, address: str) -> None:
        self.x, self.y, self.windows, self.lost_lines = 0.0, 0.0, 0, 0
        self._address = address
        self._port: serial.Serial | None = None
        self._receiver = SerialReceiver("ccsds-cobs")
        self._window, self._sum, self._updated_s = 0, [0, 0, 0], float("-inf")

    @property
    def is_fresh(self) -> bool:
        """Return whether a navigation filter may use the position."""
        return self._port is not None and time.monotonic() - self._updated_s < STALE_S

    def poll(self) -> None:
        """Read the received bytes; open the port again when it was lost. Call it in a loop."""
        try:
            if self._port is None:
                self._port = serial.Serial(self._address, timeout=0.1)
                self._receiver = SerialReceiver("ccsds-cobs")
            data = self._port.read(max(1, self._port.in_waiting))
        except OSError:  # serial.SerialException is one
            self._lose()
            return
        self._receiver.push(data)
        for t, x, y, _ in self._receiver.take_events().tolist():
            if t // WINDOW_US != self._window:
                self._complete(t // WINDOW_US)
            self._sum = [self._sum[0] + x, self._sum[1] + y, self._sum[2] + 1]

    def _complete(self, next_window: int) -> None:
        x, y, count = self._sum
        if count >= MIN_EVENTS:
            self.x, self.y, self._updated_s = x / count, y / count, time.monotonic()
            self.windows += 1
        self._window, self._sum = next_window, [0, 0, 0]

    def _lose(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None
            self.lost_lines += 1
        self._sum = [0, 0, 0]
        time.sleep(0.05)


if __name__ == "__main__":
    centroid, printed = Centroid(sys.argv[1]), (-1, False)
    while True:
        centroid.poll()
        state = (centroid.windows, centroid.is_fresh)
        if state != printed:
            printed = state
            print(f"x {centroid.x:.1f}, y {centroid.y:.1f}" if centroid.is_fresh else "no position", flush=True)
