"""The decoder on a Cortex-M3 (mps2-an385 in QEMU): what arrives on its UART comes out, event by event."""

import numpy as np
import pytest
from block_strategies import stream

from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.events import EDGE
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.telemetry.reading import as_received
from firmware_protocol.telemetry.writing import BlockEncoder
from tests.firmware_protocol.c.board import Board, build_firmware
from transports.link.deliveries import digest_of

pytestmark = [pytest.mark.arm, pytest.mark.socket]

SIZE = (346, 260)


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    running = Board(build_firmware(tmp_path_factory.mktemp("firmware")))
    yield running
    running.close()


def telemetry(profile, events):
    """Return the bytes on the line, and the events as a receiver gets them."""
    encoder, wrapped, received = BlockEncoder(SIZE), [], []
    while len(events):
        data, taken = encoder.encode(events, dropped=1)
        wrapped.append(profile.wrap(Message(MessageKind.EVENTS, data, int(events["t"][0]))))
        received.append(as_received(events[:taken], 1))
        events = events[taken:]
    return wrapped, np.concatenate(received)


@pytest.mark.parametrize(
    ("letter", "name"), [("c", "ccsds-cobs"), ("s", "ccsds-slip"), ("k", "ccsds-kiss"), ("x", "csp-kiss")]
)
def test_telemetry(board, letter, name):
    board.ask(letter)
    profile = Profile(name)
    wrapped, events = telemetry(profile, stream(SIZE, 2000, 50_000, 1, start_us=2**33))
    edges = np.array([(2**33, 2, 0, 1), (2**33 + 4, 3, 0, 2)], EDGE)
    wrapped.append(profile.wrap(Message(MessageKind.EDGES, BlockEncoder(SIZE).encode_edges(edges, 1), 2**33)))
    told = board.feed(b"".join(wrapped))
    assert (told["events"], told["digest"], told["edges"]) == (len(events), digest_of(events), 2)
    assert (told["packets"], told["dropped"], told["missing"], told["errors"]) == (len(wrapped), len(wrapped), 0, 0)


def test_telemetry_with_damage(board):
    board.ask("c")
    wrapped, _ = telemetry(Profile(), stream(SIZE, 2000, 50_000, 2))
    data = wrapped[0] + wrapped[2][:100] + b"\x55" + wrapped[2][100:] + wrapped[3]
    told = board.feed(data)
    assert (told["packets"], told["missing"], told["errors"]) == (2, 2, 1)


def test_davis_words(board):
    board.ask("d")
    events = stream(SIZE, 2000, 200_000, 3)
    told = board.feed(WordEncoder(SIZE).encode(events).words.tobytes())
    assert (told["events"], told["digest"], told["errors"]) == (len(events), digest_of(events), 0)
