"""The selector of a link's process: as fine as select, and not limited to its 1024 file descriptors."""

import asyncio
import fcntl
import os
import resource
import time

import pytest

from transports.link.pacing import FineSelector


@pytest.fixture
def high():
    """Two ends of a pipe, the reading one with a number that select cannot take."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < 2100:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(2100, hard), hard))
    low, write = os.pipe()
    read = fcntl.fcntl(low, fcntl.F_DUPFD, 2000)
    os.close(low)
    yield read, write
    os.close(read)
    os.close(write)


def test_a_descriptor_above_1023_is_heard(high):
    read, write = high
    heard = []

    async def listen():
        loop = asyncio.get_running_loop()
        loop.add_reader(read, lambda: heard.append(os.read(read, 10)))
        os.write(write, b"x")
        while not heard:
            await asyncio.sleep(0)
        loop.remove_reader(read)

    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(FineSelector())) as runner:
        runner.run(asyncio.wait_for(listen(), 60))
    assert heard == [b"x"]


def test_a_wait_is_not_rounded_up_to_a_millisecond():
    with FineSelector() as selector:

        def waited_s():
            start = time.perf_counter()
            selector.select(0.0002)
            return time.perf_counter() - start

        assert min(waited_s() for _ in range(20)) >= 0.0002
        assert any(waited_s() < 0.001 for _ in range(20_000))  # rounded up, none would be, however idle the machine
