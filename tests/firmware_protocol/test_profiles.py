"""Profiles: what one side wraps, the other unwraps."""

import pytest

from firmware_protocol.packets.message import Message, MessageKind, Received
from firmware_protocol.packets.profile import PROFILES, Profile
from firmware_protocol.packets.telecommands import (
    Ping,
    RequestHousekeeping,
    SetBias,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Start,
    Stop,
)
from firmware_protocol.packets.verification import RequestId, Stage, Verification

TELECOMMANDS = [
    Ping(),
    RequestHousekeeping(),
    SetTime(5_000_001),
    Start(),
    Stop(),
    SetTick(10),
    SetRegion(0, 1, 2, 3),
    SetRateLimit(7),
    SetBias(1, 2),
]


def payload_of(kind):
    if kind is MessageKind.VERIFICATION:
        return Verification(Stage.START, RequestId(0x1AA0, 0xC001)).encode()
    return bytes(range(256)) * 4


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("kind", MessageKind)
def test_messages_come_out_as_they_went_in(name, kind):
    profile = Profile(name)
    message = Message(kind, payload_of(kind), 123_456_789)
    assert profile.unwrapper().push(profile.wrap(message)) == [Received(message)]


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("command", TELECOMMANDS)
def test_telecommands_come_out_as_they_went_in(name, command):
    profile = Profile(name)
    (received,) = profile.command_unwrapper().push(profile.wrap_command(command))
    assert received.command == command
    assert received.request == profile.last_request
    assert received.failure is None
