"""Tell whoever started a run that it is ready: a file for scripts, sd_notify for a service manager.

file         one line of JSON, {"pid": ..., "links": {NAME: ADDRESS or null}}; it appears whole or not at all
sd_notify    READY=1 to the socket that $NOTIFY_SOCKET names (systemd.exec, Type=notify)
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

__all__ = ["ReadySignal"]


class ReadySignal:
    """Tells once, at the first call of `tell`.

    Parameters
    ----------
    path : the file to write; None for none.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._told = False

    def tell(self, addresses: Mapping[str, str | None]) -> None:
        """Say that every link is open, at these addresses; raises OSError when the file cannot be written."""
        if self._told:
            return
        self._told = True
        if self._path is not None:
            part = self._path.with_name(self._path.name + ".part")
            part.write_text(json.dumps({"pid": os.getpid(), "links": dict(addresses)}) + "\n", encoding="utf-8")
            part.replace(self._path)
        _notify("READY=1")


def _notify(message: str) -> None:
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as service_manager:
        service_manager.connect("\0" + address[1:] if address.startswith("@") else address)
        service_manager.send(message.encode())
