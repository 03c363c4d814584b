"""The queue of a writer process: its bound, and messages beyond it."""

import os
import threading

from transports.recording.writer_process import PipeQueue


def test_messages_without_room_are_refused_whole():
    queue = PipeQueue(10)
    assert queue.put([b"12345", b"678"], wait=False)
    assert not queue.put([b"9", b"ab"], wait=False)
    assert (queue.waiting_bytes, queue.room_bytes) == (8, 2)
    queue.stop()
    assert queue.room_bytes == 0
    assert not queue.put([b"1"], wait=True)


def test_an_empty_queue_accepts_a_message_beyond_its_capacity():
    queue = PipeQueue(10)
    assert queue.put([b"longer than the queue"], wait=False)
    assert not queue.put([b"x"], wait=False)


def test_the_last_messages_need_no_room_and_all_are_sent_in_order():
    queue = PipeQueue(4)
    out, into = os.pipe()
    sender = threading.Thread(target=queue.send_all, args=[into])
    sender.start()
    for piece in (b"abcd", b"efgh", b"longer than the queue"):
        assert queue.put([piece], wait=True)
    queue.end([b" and the end"])
    sender.join(60)
    os.close(into)
    assert os.read(out, 1 << 16) == b"abcdefghlonger than the queue and the end"
    os.close(out)
    assert queue.waiting_bytes == 0
