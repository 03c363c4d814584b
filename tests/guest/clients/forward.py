"""Forwards a TCP port of this machine to another address, as `ssh -L` does; its process id is in FILE once it listens.

forward.py PORT ADDRESS THERE FILE
"""

import os
import socket
import sys
import threading
from pathlib import Path


def pass_on(source, destination):
    while data := source.recv(1 << 16):
        destination.sendall(data)
    destination.shutdown(socket.SHUT_WR)


def main():
    port, address, there = int(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    with socket.create_server(("127.0.0.1", port)) as listener:
        Path(sys.argv[4]).write_text(str(os.getpid()))
        while True:
            here, _ = listener.accept()
            beyond = socket.create_connection((address, there))
            for pair in ((here, beyond), (beyond, here)):
                threading.Thread(target=pass_on, args=pair, daemon=True).start()


if __name__ == "__main__":
    main()
