"""A receiver of CAN frames: what is taken is forgotten, answers are read, and replies are bounded."""

import numpy as np
import pytest

from firmware_protocol.can_frames.dbc import Identifiers
from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.raw_events import pack_marks
from firmware_protocol.can_frames.transport import IsoTpSender
from firmware_protocol.events import make_edges
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.profile import Profile
from firmware_protocol.receiver.can import CanReceiver, CanReceiverSettings


def frames_of(message, settings):
    """Return the frames of a message by ISO-TP, without waiting for flow control."""
    peer = settings.isotp
    ours = type(peer)(peer.receive, peer.send, flow_control=False)
    sender = IsoTpSender(ours)
    sender.start(Profile("ccsds").wrap(message))
    now_ns = 0
    while sender.busy:
        now_ns += 1_000_000
        if (frame := sender.next_frame(now_ns)) is not None:
            yield frame


@pytest.mark.system
def test_edges_are_taken_once_and_bounded():
    receiver = CanReceiver()
    edges = make_edges([10, 20, 30], 3)
    for data in pack_marks(edges):
        receiver.push(Frame(Identifiers().edges, data))
    assert np.array_equal(receiver.take_edges(), edges)
    assert len(receiver.take_edges()) == 0
    for _ in range(70_000):
        receiver.push(Frame(Identifiers().edges, bytes(4) + b"\3\0\0\0"))
    assert len(receiver.take_edges()) == 1 << 16
    assert receiver.counts["edges not taken"] == 70_000 - (1 << 16)


def test_answers_and_housekeeping_are_read():
    settings = CanReceiverSettings(Identifiers.of_node(5))
    receiver = CanReceiver(settings)
    told = Housekeeping(t_us=7, region=(0, 0, 346, 260))
    for message in (Message(MessageKind.PONG, b"", 0), Message(MessageKind.HOUSEKEEPING, told.encode(), 0)):
        for frame in frames_of(message, settings):
            receiver.push(frame)
    assert receiver.take_reports() == ("pong",)
    assert receiver.housekeeping == told
    assert receiver.counts["messages: housekeeping"] == receiver.counts["messages: pong"] == 1


def test_replies_are_for_the_first_frames_and_bounded():
    settings = CanReceiverSettings()
    receiver, first = CanReceiver(settings), Frame(settings.identifiers.telemetry, b"\x10\x64" + bytes(6))
    receiver.push(first)
    (reply,) = receiver.take_replies()
    assert reply.identifier == settings.identifiers.telecommand
    assert reply.data[:3] == b"\x30\0\0"
    for _ in range(200):
        receiver.push(first)
    assert len(receiver.take_replies()) == 64
    assert receiver.take_replies() == []
