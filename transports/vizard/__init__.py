"""The socket to which a Basilisk simulation connects."""
