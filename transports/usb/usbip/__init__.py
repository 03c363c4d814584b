"""USB/IP on sockets: a server that offers device models, and a host in user space without a kernel module."""
