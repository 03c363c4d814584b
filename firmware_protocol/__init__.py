"""Bytes to values and back: device models and codecs. No I/O, no clock, no thread."""
