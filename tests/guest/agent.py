"""The guest's process 1: runs what the host asks for, one TCP connection to the host for each command.

The guest keeps one idle connection open. The host sends a JSON object and a newline on it:

    {"argv": [...], "timeout_s": 30.0}

and gets back, when the program has ended, {"code": 0, "stdout": "...", "stderr": "..."}; `code` is null when time ran
out. The guest opens the next idle connection as soon as this one is in use, so commands may run side by side.
When the host closes the idle connection the agent ends, and the guest with it.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
from typing import Any


def main() -> None:
    host, port = sys.argv[1], int(sys.argv[2])
    while True:
        connection = socket.create_connection((host, port))
        request = connection.makefile("rb").readline()
        if not request:
            return
        threading.Thread(target=answer, args=(connection, json.loads(request))).start()


def answer(connection: socket.socket, request: dict[str, Any]) -> None:
    with connection:
        connection.sendall(json.dumps(run(request["argv"], request["timeout_s"])).encode() + b"\n")


def run(argv: list[str], timeout_s: float) -> dict[str, Any]:
    try:
        done = subprocess.run(argv, capture_output=True, stdin=subprocess.DEVNULL, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired as error:
        return {"code": None, "stdout": text(error.stdout), "stderr": text(error.stderr)}
    except OSError as error:
        return {"code": 127, "stdout": "", "stderr": str(error)}
    return {"code": done.returncode, "stdout": text(done.stdout), "stderr": text(done.stderr)}


def text(output: bytes | None) -> str:
    return (output or b"").decode(errors="replace")


if __name__ == "__main__":
    main()
