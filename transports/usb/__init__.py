"""USB: hosts, USB/IP, and the loopback of a camera and its reader."""
