"""Event streams of common programs, as bytes for a TCP connection or as datagrams."""
