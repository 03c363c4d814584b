"""A word when something takes long."""

import logging
import threading

from emulator.run.session import log_if_slow


def test_what_is_quick_is_not_talked_about(caplog):
    with caplog.at_level(logging.INFO), log_if_slow("compiling", after_s=60.0):
        pass
    assert caplog.messages == []


def test_what_is_slow_is_said_while_it_lasts(caplog):
    said, messages = threading.Event(), []

    class Listener(logging.Handler):
        def emit(self, record):
            messages.append(record.getMessage())
            said.set()

    logger = logging.getLogger("emulator.run.session")
    logger.addHandler(listener := Listener())
    with caplog.at_level(logging.INFO), log_if_slow("compiling", after_s=0.01):
        assert said.wait(60.0)
    logger.removeHandler(listener)
    assert messages == ["compiling"]
