"""Transports of bytes between a camera and the device under test: links, pacing, and a fake for each."""
