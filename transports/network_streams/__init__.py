"""Links that send events to programs on a network: a TCP server, and datagrams."""
