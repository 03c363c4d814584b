"""What a camera tells its host unasked: octets, repetition until the host answers, and what ends it."""

import struct

import pytest
from gige_host import Host

from firmware_protocol.events import EdgeKind, make_edges
from firmware_protocol.gige.control import Messages, MessageSettings
from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2_registers import Evs

MS = 1_000_000


def _edges(*times_us):
    return make_edges(times_us, EdgeKind.RISING)


def _answer(message):
    return struct.pack(">HHHH", 0, 0xC1, 0, int.from_bytes(message[6:8], "big"))


def _host():
    return _with_messages(Host())


def _with_messages(host):
    host.start()
    for address, value in (
        (Register.MESSAGE_ADDRESS, 0x7F000001), (Register.MESSAGE_PORT, 51_000), (Evs.EVENT_NOTIFICATION, 1),
    ):  # fmt: skip
        assert host.write(address, value) == 0
    return host


def test_golden_octets_of_a_message():
    host = _host()
    host.camera.offer_edges(_edges(7))
    message = host.camera.messages.next(0, host.camera.message_settings)
    assert message.hex(" ", 2) == "4200 00c0 0010 0001 0000 9000 ffff 0000 0000 0000 0000 1b58"
    assert host.camera.message_destination == (0x7F000001, 51_000)


def test_golden_octets_of_a_message_with_data_and_its_answer():
    host = _host()
    assert host.write(Evs.EVENT_NOTIFICATION, 2) == 0
    host.camera.offer_edges(_edges(7))
    messages, settings = host.camera.messages, MessageSettings(10 * MS, retries=1)
    message = messages.next(0, settings)
    assert message.hex(" ", 2) == "4201 00c2 0014 0001 0000 9000 ffff 0000 0000 0000 0000 1b58 0000 0002"
    messages.answered(_answer(message))  # of an EVENT: not this one's
    assert messages.next(10 * MS, settings) == message
    messages.answered(struct.pack(">HHHH", 0, 0xC3, 0, 1))
    assert messages.next(90 * MS, settings) is None
    assert messages.counts == {"messages": 1}


def test_messages_are_repeated_until_the_host_answers_and_no_oftener_than_it_said():
    messages, settings = Messages(), MessageSettings(10 * MS, retries=2)
    messages.queue(0x9000, 1)
    messages.queue(0x9000, 2)
    first = messages.next(0, settings)
    assert first[1] == 1
    assert messages.next(9 * MS, settings) is None
    assert [messages.next(k * 10 * MS, settings) for k in (1, 2)] == [first, first]
    second = messages.next(30 * MS, settings)
    assert (second[-1], second[6:8]) == (2, b"\0\2")
    messages.answered(_answer(first))
    assert messages.next(39 * MS, settings) is None
    messages.answered(_answer(second))
    assert messages.next(90 * MS, settings) is None
    assert messages.counts == {"messages": 2, "messages lost": 1}


def test_without_a_timeout_no_answer_is_asked_for():
    messages = Messages()
    messages.queue(0x9000, 1)
    messages.queue(0x9000, 2)
    assert [messages.next(0, MessageSettings())[1] for _ in range(2)] == [0, 0]
    assert messages.next(0, MessageSettings()) is None


def test_more_messages_than_can_wait_are_counted():
    messages = Messages()
    for k in range(300):
        messages.queue(0x9000, k)
    assert messages.counts["messages lost"] == 300 - 256


@pytest.mark.parametrize(
    ("register", "value"), [(Evs.EVENT_NOTIFICATION, 0), (Register.MESSAGE_PORT, 0), (Register.PRIVILEGE, 0)]
)
def test_nobody_is_told_who_does_not_want_it(register, value):
    host = _host()
    assert host.write(register, value) == 0
    host.camera.offer_edges(_edges(7))
    assert host.camera.messages.next(0, MessageSettings()) is None


def test_the_message_of_an_edge_from_before_the_start_has_the_time_of_the_start():
    host = Host()
    host.camera.advance(1000)
    _with_messages(host)
    host.camera.offer_edges(_edges(990))
    assert struct.unpack(">Q", host.camera.messages.next(0, MessageSettings())[-8:]) == (0,)
    host.camera.advance(5000)
    assert host.collect()[1]["t"].tolist() == [0]


def test_who_takes_control_next_is_told_nothing():
    host = _host()
    host.write(Register.PRIVILEGE, 0)
    host.start()
    assert (host.read(Register.MESSAGE_PORT), host.read(Evs.EVENT_NOTIFICATION)) == (0, 0)
    assert host.camera.message_destination is None
