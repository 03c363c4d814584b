"""A computer on a damaged line: what is lost is counted, and no wrong event is taken."""

import functools

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import example, given

from firmware_protocol.framing import DEFAULT_MAX_PAYLOAD
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import PROFILES, Profile
from firmware_protocol.packets.telecommands import Ping, SetRegion, Start
from firmware_protocol.receiver.instrument import SerialReceiver
from tests.made_events import scattered

LINES = [name for name in PROFILES if "-" in name or name == "fprime"]
SIZE = (346, 260)


def stream(count):
    return scattered(np.cumsum(np.random.default_rng(7).integers(1, 20, count)), SIZE)


def frames(profile, count=2000, **changes):
    """Return the frames of a stream, and the events of each as a receiver will see them."""
    instrument = Instrument(SIZE, InstrumentSettings(housekeeping_s=0, block_bytes=256, **changes))
    instrument.offer(stream(count))
    wrapped, seen, writer = [], [], Profile(profile)
    while (outgoing := instrument.next_message()) is not None:
        wrapped.append(writer.wrap(outgoing.message))
        seen.append(outgoing.events)
        instrument.sent(outgoing)
    return wrapped, seen


@functools.cache
def data_of(profile):
    return frames(profile)


def heard_of(receiver, data):
    receiver.push(data)
    return receiver.take_events()


@pytest.mark.parametrize("profile", LINES)
def test_any_cut_of_the_bytes_gives_the_same(profile):
    wrapped, seen = data_of(profile)
    data, receiver = b"".join(wrapped), SerialReceiver(Profile(profile))
    parts = [heard_of(receiver, data[at : at + 37]) for at in range(0, len(data), 37)]
    assert np.array_equal(np.concatenate(parts), np.concatenate(seen))
    assert receiver.faults == 0


@given(st.sampled_from(LINES), st.floats(0, 0.999), st.sampled_from(["flip", "lose", "insert"]), st.data())
@example("fprime", 0.9059972525399106, "lose", None)  # the first byte of a length
def test_one_damaged_byte_costs_two_blocks_at_most_and_is_counted(profile, where, what, data):
    """A damaged length lets a receiver wait for the longest frame, so the line goes on for as long."""
    wrapped, seen = data_of(profile)
    line = bytearray(b"".join(wrapped))
    at = len(wrapped[0]) + int(where * (len(line) - len(wrapped[0]) - len(wrapped[-1]) - len(wrapped[-2])))
    if what == "flip":
        line[at] ^= 1 << data.draw(st.integers(0, 7))
    elif what == "lose":
        del line[at]
    else:
        line.insert(at, data.draw(st.integers(0, 255)))
    receiver = SerialReceiver(Profile(profile))
    got = heard_of(receiver, bytes(line) + bytes(DEFAULT_MAX_PAYLOAD + 100))
    blocks = {block.tobytes() for block in seen}
    kept = [block for block in seen if block.tobytes() in got.tobytes()]
    assert len(seen) - len(kept) <= 2
    assert len(got) == sum(map(len, kept)), "no event but those of whole blocks"
    assert len(blocks) == len(seen)
    if len(kept) < len(seen):
        assert receiver.faults > 0
        assert receiver.counts["messages_missing"] == len(seen) - len(kept)


def test_joining_in_the_middle_of_a_frame_is_no_fault():
    wrapped, seen = data_of("ccsds-cobs")
    receiver = SerialReceiver(Profile())
    assert len(heard_of(receiver, b"".join(wrapped)[len(wrapped[0]) // 2 :])) == sum(map(len, seen[1:]))
    assert receiver.faults == 0
    assert sum(count for name, count in receiver.counts.items() if name.startswith("damaged")) == 1


def test_being_lost_and_found_again_is_told():
    wrapped, _ = data_of("ccsds-cobs")
    receiver = SerialReceiver(Profile())
    for index, frame in enumerate(wrapped[:6]):
        receiver.push(frame if index != 2 else bytes([frame[0] ^ 1]) + frame[1:])
    assert receiver.counts["resynchronised"] == 1
    assert receiver.faults == 2, "a damaged frame, and a gap where it was"


@given(st.sampled_from(LINES), st.binary(max_size=3000))
def test_noise_is_no_event(profile, noise):
    receiver = SerialReceiver(profile)
    receiver.push(noise)
    assert len(receiver.take_events()) == len(receiver.take_edges()) == 0


def test_a_sound_packet_with_a_bad_block_is_a_fault():
    receiver, sender = SerialReceiver(Profile()), Profile()
    assert len(heard_of(receiver, sender.wrap(Message(MessageKind.EVENTS, b"no block at all", 0)))) == 0
    receiver.push(sender.wrap(Message(MessageKind.HOUSEKEEPING, b"short", 0)))
    assert receiver.take_reports() == ()
    assert receiver.counts["bad_blocks"] == receiver.counts["bad_answers"] == 1
    assert receiver.faults == 2


def test_answers_are_told_with_the_command_they_belong_to():
    instrument = Instrument(SIZE, InstrumentSettings(housekeeping_s=0))
    ours, theirs = Profile(), Profile()
    receiver, commands = SerialReceiver(ours), theirs.command_unwrapper()
    for command in (Start(), SetRegion(300, 0, 100, 1)):
        for received in commands.push(receiver.wrap(command)):
            instrument.command(received)
    told = []
    while (outgoing := instrument.next_message()) is not None:
        receiver.push(theirs.wrap(outgoing.message))
        told += receiver.take_reports()
    assert told[:3] == ["Start: acceptance good", "Start: completion good", "SetRegion: acceptance good"]
    assert told[3].startswith("SetRegion: completion failed: region [300, 0, 100, 1] reaches beyond")


def test_reports_that_nobody_takes_are_bounded_and_counted():
    receiver, sender = SerialReceiver(), Profile()
    for _ in range(3000):
        receiver.push(sender.wrap(Message(MessageKind.PONG, b"", 0)))
    assert len(receiver.take_reports()) == 1024
    assert receiver.counts["reports not taken"] == 3000 - 1024
    assert receiver.take_reports() == ()


def test_requests_that_nobody_answers_are_bounded():
    receiver = SerialReceiver()
    for _ in range(3000):
        receiver.wrap(Ping())
    assert len(receiver._messages._requests) == 1024


def test_an_unknown_profile_is_refused():
    with pytest.raises(ValueError, match="no profile 'morse'"):
        SerialReceiver("morse")
