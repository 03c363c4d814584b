"""A word when something takes long, and none when it does not."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["said_if_slow"]

log = logging.getLogger(__name__)


@contextmanager
def said_if_slow(message: str, after_s: float = 5.0) -> Iterator[None]:
    """Log `message` when the block has not ended after `after_s`."""
    timer = threading.Timer(after_s, log.info, [message])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
