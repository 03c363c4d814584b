"""A worker: a process that does one run of a campaign after the other, as it is told over a socket.

    orders, JSON:   {"source": {...}, "folder": ..., "threads": 1}     once
                    {"index": 17, "worker": 0}                         for each run
    answers, JSON:  {"ready": true}                                    once
                    {"row": {...}} | {"stopped": "why the campaign cannot go on"} | {"abandoned": true}

It ends when the socket is closed. SIGTERM abandons the run at hand; it comes also when whoever started the worker dies.
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

__all__ = ["main"]

_PR_SET_PDEATHSIG = 1


class _Worker:
    """One campaign, run by run."""

    def __init__(self, socket: Connection) -> None:
        self._socket = socket
        self._session: Session | None = None
        self._abandoned = False

    def serve(self) -> None:
        """Answer orders until the other side is gone."""
        told = json.loads(self._socket.recv_bytes())
        try:
            campaign = Campaign(Source(**told["source"]))
        except (CampaignError, RigError) as error:
            self._answer({"stopped": str(error)})
            return
        gc.freeze()  # what is loaded stays: no collection need look at it again
        self._answer({"ready": True})
        while not self._abandoned:
            order = json.loads(self._socket.recv_bytes())
            place = Place(Path(told["folder"]), order["worker"], told["threads"])
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
        """End the run at hand after its present step, without a row."""
        self._abandoned = True
        if self._session is not None:
            self._session.stop()


def _end_with_parent() -> None:
    """Let the kernel send SIGTERM when whoever started the worker dies: a run of minutes must not go on for nobody."""
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def main() -> None:
    """Serve the socket whose number is the first argument."""
    descriptor = int(sys.argv[1])
    os.set_inheritable(descriptor, False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for whoever started the worker
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    worker = _Worker(Connection(descriptor))
    signal.signal(signal.SIGTERM, worker.abandon)
    _end_with_parent()
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):  # nobody is left to answer to
        worker.serve()


if __name__ == "__main__":
    main()
