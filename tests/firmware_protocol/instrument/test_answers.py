"""Answers in order, with the time of their making, the oldest lost beyond 256."""

from firmware_protocol.instrument.instrument import Answers
from firmware_protocol.instrument.queue import OwnTime
from firmware_protocol.packets.addresses import Message, MessageKind


def test_answers_come_in_order_with_their_time():
    time = OwnTime()
    answers = Answers(time)
    answers.put(MessageKind.PONG, b"")
    time.reach(9)
    answers.put(MessageKind.TIME, b"x")
    assert answers.take() == Message(MessageKind.PONG, b"", 0)
    assert answers.take() == Message(MessageKind.TIME, b"x", 9)
    assert answers.take() is None


def test_the_oldest_are_lost():
    answers = Answers(OwnTime())
    for number in range(300):
        answers.put(MessageKind.TIME, bytes([number & 255]))
    taken = []
    while (answer := answers.take()) is not None:
        taken.append(answer.payload[0])
    assert taken == [number & 255 for number in range(44, 300)]
