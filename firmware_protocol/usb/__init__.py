"""Common parts of USB cameras: descriptors, control requests, and the USB/IP messages."""
