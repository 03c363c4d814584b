"""A worker: a process that does one run of a campaign after the other, by orders over a socket.

    orders, JSON:   {"source": {...}, "folder": ..., "threads": 1}     once
                    {"index": 17, "worker": 0}                         for each run
    answers, JSON:  {"ready": true}                                    once
                    {"row": {...}} | {"stopped": "why the campaign cannot go on"} | {"abandoned": true}

It ends when the socket is closed. SIGTERM abandons the present run; it comes also when the parent process dies.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import sys
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

from emulator.campaign.campaign import Campaign
from emulator.campaign.loading import CampaignError, Source
from emulator.campaign.one_run import CampaignStopped, Place, run_row
from emulator.rig.loading import RigError
from emulator.run.session import Session

_PR_SET_PDEATHSIG = 1


class _Worker:
    """Loop of a worker over the runs of one campaign."""

    def __init__(self, socket: Connection) -> None:
        self._socket = socket
        self._session: Session | None = None
        self._abandoned = False

    def serve(self) -> None:
        """Answer orders until the other side disconnects."""
        setup = json.loads(self._socket.recv_bytes())
        try:
            campaign = Campaign(Source(**setup["source"]))
        except (CampaignError, RigError) as error:
            self._answer({"stopped": str(error)})
            return
        gc.freeze()  # loaded modules stay: no collection need examine them again
        self._answer({"ready": True})
        while not self._abandoned:
            order = json.loads(self._socket.recv_bytes())
            place = Place(Path(setup["folder"]), order["worker"], setup["threads"])
            self._answer(self._done(campaign, order["index"], place))

    def _done(self, campaign: Campaign, index: int, place: Place) -> dict[str, object]:
        try:
            row = run_row(campaign, index, place, self._take)
        except CampaignStopped as error:
            return {"stopped": str(error)}
        return {"abandoned": True} if self._abandoned else {"row": row}

    def _take(self, session: Session) -> None:
        self._session = session
        if self._abandoned:
            session.stop()

    def _answer(self, message: dict[str, object]) -> None:
        self._socket.send_bytes(json.dumps(message).encode())

    def abandon(self, *_: object) -> None:
        """End the present run after its present step, without a row."""
        self._abandoned = True
        if self._session is not None:
            self._session.stop()


def main() -> None:
    """Serve the socket whose number is the first argument."""
    descriptor = int(sys.argv[1])
    os.set_inheritable(descriptor, False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent process
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    worker = _Worker(Connection(descriptor))
    signal.signal(signal.SIGTERM, worker.abandon)
    with suppress(AttributeError, OSError):  # SIGTERM also when the parent process dies: the run must then not go on
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the other side has disconnected
        worker.serve()


if __name__ == "__main__":
    main()
