"""Who may use the page."""

import pytest

from emulator.live_page.messages import Access, Address, parse_address


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("127.0.0.1:8080", Address("127.0.0.1", 8080)),
        (":8080", Address("127.0.0.1", 8080)),
        ("0.0.0.0", Address("0.0.0.0", 0)),
        ("[::1]:80", Address("::1", 80)),
        ("bench.local:9000", Address("bench.local", 9000)),
    ],
)
def test_an_address_is_read(text, address):
    assert parse_address(text) == address


@pytest.mark.parametrize("text", ["127.0.0.1:99999", "1.2.3.4:x", "a/b", "me@host:1", "[::1", "host:1?x"])
def test_what_is_no_address_is_refused(text):
    with pytest.raises(ValueError, match="HOST:PORT"):
        parse_address(text)


def test_a_token_is_made_where_others_can_reach_the_page_and_it_alone_is_permitted():
    open_, closed = Access.for_host("127.0.0.1"), Access.for_host("0.0.0.0")
    assert open_.token == ""
    assert open_.permits("anything")
    assert len(closed.token) == 32
    assert closed.permits(closed.token)
    assert not closed.permits("")
    assert not closed.permits(closed.token[:-1] + "\N{SNOWMAN}")
    assert not closed.permits("\ud800")
    assert not closed.origin_permitted("http://[", "10.0.0.1:81")
    assert Access.for_host("0.0.0.0").token != closed.token


@pytest.mark.parametrize(
    ("origin", "host", "permitted"),
    [
        ("http://127.0.0.1:81", "127.0.0.1:81", True),
        ("http://localhost:81", "localhost:81", True),
        (None, "127.0.0.1:81", True),  # a program, not a browser
        ("http://evil.example", "127.0.0.1:81", False),
        ("null", "127.0.0.1:81", False),
        ("http://evil.example:81", "evil.example:81", False),  # a name that resolves to 127.0.0.1
        ("http://[::1", "[::1", False),
        ("http://[", "127.0.0.1:81", False),
        (None, None, False),
    ],
)
def test_pages_of_others_are_kept_out(origin, host, permitted):
    assert Access().origin_permitted(origin, host) is permitted
