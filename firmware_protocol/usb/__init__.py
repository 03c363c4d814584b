"""What every USB camera shares: descriptors, control requests, and the USB/IP messages."""
