"""What waits for the page's process is sent when it reads again, and is bounded."""

import multiprocessing

import pytest

from emulator.live_page.page import Outbox


@pytest.fixture
def pipe():
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        yield ours, theirs


def _fill(outbox, commands_done=0):
    """Put messages until the pipe takes no more; return how many it took."""
    for number in range(10_000):
        outbox.put({"number": number, "text": "x" * 1000})
        outbox.flush(commands_done)
        if outbox.waits:
            return number
    raise AssertionError("the pipe has no end")


def _received(pipe):
    found = []
    while pipe.poll():
        found.append(pipe.recv())
    return found


def test_what_a_slow_page_has_not_taken_is_sent_later_and_nothing_blocks(pipe):
    outbox = Outbox(pipe[0])
    taken = _fill(outbox)
    outbox.put({"number": taken + 1})
    for status in range(3):
        outbox.renew({"status": status})
    outbox.flush(commands_done=7)
    assert outbox.waits
    found = _received(pipe[1])
    outbox.flush(commands_done=7)
    found += _received(pipe[1])
    assert [message["number"] for message in found[:-1]] == list(range(taken + 2))
    assert found[-1] == {"status": 2, "commands_done": 7}


def test_a_page_that_has_died_is_told_by_an_error(pipe):
    outbox = Outbox(pipe[0])
    pipe[1].close()
    outbox.put({"number": 1})
    with pytest.raises(OSError, match=r"[Bb]roken pipe"):
        outbox.flush(commands_done=0)
