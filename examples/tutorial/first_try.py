"""The first version of the tutorial's flight code: python first_try.py PORT. It ends when the line is lost."""

from __future__ import annotations

import sys

import serial

from evstim import SerialReceiver

WINDOW_US = 100_000


def main(address: str) -> None:
    """Print the centroid of the events of each 100 ms."""
    receiver = SerialReceiver("ccsds-cobs")
    window, xs, ys = 0, [], []
    with serial.Serial(address, timeout=0.1) as port:
        while True:
            receiver.push(port.read(max(1, port.in_waiting)))
            for t, x, y, _ in receiver.take_events().tolist():
                if t // WINDOW_US != window and xs:
                    print(f"{t / 1e6:.1f} s: x {sum(xs) / len(xs):.1f}, y {sum(ys) / len(ys):.1f}", flush=True)
                    xs, ys = [], []
                window = t // WINDOW_US
                xs.append(x)
                ys.append(y)


if __name__ == "__main__":
    main(sys.argv[1])
