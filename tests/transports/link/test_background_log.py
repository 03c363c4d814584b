"""A log that nobody reads never blocks whoever writes it."""

import os
import subprocess
import sys

from transports.link.background_log import BackgroundWriter


def test_what_is_written_arrives_in_order():
    reader, writer = os.pipe()
    out = BackgroundWriter(writer)
    for i in range(1000):
        out.write(f"{i}\n")
    assert out.drain(120.0)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        assert pipe.read() == "".join(f"{i}\n" for i in range(1000))
    assert out.dropped_bytes == 0


def test_a_full_pipe_drops_and_counts_and_does_not_block():
    reader, writer = os.pipe()
    out = BackgroundWriter(writer, capacity_bytes=100_000)
    for _ in range(10_000):
        out.write("x" * 99 + "\n")
    assert not out.drain(0.05)
    assert 700_000 < out.dropped_bytes < 1_000_000
    received = 0
    while received < 1_000_000 - out.dropped_bytes:
        received += len(os.read(reader, 1 << 16))
    assert out.drain(120.0)


def test_a_reader_that_has_gone_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)
    out = BackgroundWriter(writer)
    out.write("nobody hears this")
    assert out.drain(120.0)


def test_a_process_with_an_unread_stderr_logs_on_and_ends():
    code = (
        "import logging; from transports.link.background_log import log_in_background; log_in_background()\n"
        "for i in range(20_000): logging.warning('line %d of a log that nobody reads', i)\n"
        "print('done', flush=True)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"done\n"
        assert process.wait(120) == 0
