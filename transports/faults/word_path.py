"""The way of a DAVIS346's words through the faults, and the watch over what arrives until all is as it was."""

from __future__ import annotations

from collections.abc import Sequence

from firmware_protocol.davis346.settings import PRODUCT_ID, VENDOR_ID
from firmware_protocol.usb.device import Identity, Transfer
from transports.faults.survivors import Survivors
from transports.faults.word_stages import SentWords, WordStage, inserted

__all__ = ["WordPath"]


class WordPath:
    """Changes transfers of one camera.

    Attributes
    ----------
    front
        Words that go before the next transfer.
    """

    def __init__(self, camera: Identity) -> None:
        self._has_words = (camera.vendor_id, camera.product_id) == (VENDOR_ID, PRODUCT_ID)
        self._survivors: Survivors | None = None
        self._epoch_us = self._next_front = 0
        self.front: list[int] = []

    def needed(self, stages: Sequence[WordStage]) -> bool:
        """Return whether transfers have to come this way."""
        return self._has_words and bool(stages or self.front or self._survivors)

    def room(self, stages: Sequence[WordStage], max_bytes: int) -> int:
        """Return how much the camera may give, so that what arrives fits into `max_bytes`."""
        self._next_front = min(len(self.front), max_bytes // 4)  # half of a transfer at most
        max_bytes -= 2 * self._next_front
        for stage in reversed(stages):
            max_bytes = stage.room(max_bytes)
        return max_bytes

    def changed(self, transfer: Transfer, stages: Sequence[WordStage]) -> Transfer:
        """Return what arrives of a transfer, with the events and edges that survive."""
        sent = SentWords.of(transfer.data)
        for stage in stages:
            sent = stage.change(sent)
        sent, self.front = inserted(sent, 0, self.front[: self._next_front]), self.front[self._next_front :]
        if self._survivors is None or transfer.epoch_us != self._epoch_us:
            # A clock that starts anew begins a stream for a receiver that knows nothing of the one before.
            self._survivors, self._epoch_us = Survivors(), transfer.epoch_us
        arrived = self._survivors.of(transfer, sent)
        if not stages and not self.front and self._survivors.agree:
            self._survivors = None
        return arrived
