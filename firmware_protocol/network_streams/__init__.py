"""Event streams of programs that people use, as bytes for a TCP connection or as datagrams."""
