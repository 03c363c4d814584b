"""The page of packets and the list of messages show what the code does: tables, and examples octet by octet."""

import re
from pathlib import Path

import pytest
from icd_examples import EXAMPLES

from firmware_protocol.davis346.biases import BIASES
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import TELECOMMANDS, Ping, SetBias, SetRegion, SetTick, SetTime

DOCS = Path(__file__).parents[2] / "docs"
PAGE, MESSAGES = ((DOCS / name).read_text(encoding="utf-8") for name in ("packets.md", "traces/messages.txt"))
LINE = re.compile(r"((?:(?:[0-9a-f]{2})+ )*(?:[0-9a-f]{2})+)(?:  |$)")


def example_of(name):
    """Return the octets below the name of an example, in the list of messages or in a box of the page."""
    example = rf"^{re.escape(name)}\n((?:(?:[0-9a-f]{{2}})+(?: .*)?\n)+)(?:\n|```$|\Z)"
    (text,) = re.findall(example, f"{PAGE}\n{MESSAGES}", re.MULTILINE)
    return b"".join(bytes.fromhex(LINE.match(line)[1]) for line in text.splitlines())


def rows_of(heading):
    section = PAGE.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    return cells[2:]


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_what_is_sent(name):
    assert example_of(name) == EXAMPLES[name]


def test_every_message_is_in_the_table_with_its_numbers():
    rows = {row[0]: row for row in rows_of("Messages of the instrument")}
    assert set(rows) == {kind.name for kind in MessageKind}
    for kind in MessageKind:
        _, apid, types, port, _, _ = rows[kind.name]
        service = int(types.split(",")[0])
        subtype = 7 if kind is MessageKind.VERIFICATION else int(types.split(",")[1])
        payload = bytes([subtype]) + bytes(4) if kind is MessageKind.VERIFICATION else b""
        packet = Profile("ccsds").wrap(Message(kind, payload, 0))
        assert int.from_bytes(packet[:2], "big") & 0x7FF == int(apid, 16)
        assert (packet[7], packet[8]) == (service, subtype)
        header = int.from_bytes(Profile("csp").wrap(Message(kind, payload, 0))[:6], "big")
        assert header >> 12 & 63 == int(port)
        assert header >> 6 & 63 == 8, "source port"
        assert header >> 46 == (3 if kind in (MessageKind.EVENTS, MessageKind.EDGES) else 2), "priority"


SHORT = {SetTick: SetTick(1), SetTime: SetTime(0), SetRegion: SetRegion(0, 0, 1, 1), SetBias: SetBias(0, 0)}


def test_every_telecommand_is_in_the_table_with_its_length():
    rows = {row[0]: row for row in rows_of("Telecommands")}
    assert set(rows) == {kind.__name__ for kind in TELECOMMANDS.values()}
    for kind in TELECOMMANDS.values():
        types, length = rows[kind.__name__][1:3]
        assert tuple(int(part) for part in types.split(",")) == kind.TYPE
        data = (SHORT[kind] if kind in SHORT else kind(0) if kind.__name__ == "SetRateLimit" else kind()).encode()
        assert len(data) == int(length)


def test_the_numbers_of_biases_are_those_that_the_page_names():
    (row,) = (row for row in rows_of("Telecommands") if row[0] == "SetBias")
    named = set()
    for first, last in re.findall(r"(\d+)(?: to (\d+))?", row[4].split(";")[0]):
        named |= set(range(int(first), int(last or first) + 1))
    assert named == {bias.address for bias in BIASES}


def test_a_telecommand_by_csp_has_high_priority_and_both_ports_8():
    header = int.from_bytes(Profile("csp").wrap_command(Ping())[:6], "big")
    assert (header >> 46, header >> 12 & 63, header >> 6 & 63) == (1, 8, 8)
