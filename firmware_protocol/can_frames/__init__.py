"""CAN without I/O: frames and their contents, bit times, arbitration and transports."""
