"""Frames on a byte line: COBS, SLIP, KISS and F Prime, each with `frame(payload)` and a `Deframer`."""
