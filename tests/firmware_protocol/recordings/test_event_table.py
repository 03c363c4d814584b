"""Tables of events as text: the usual ones of data sets, what is assumed, and what is refused with its line."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EVENT, join_events
from firmware_protocol.recordings.event_table import EventTable, TableForm, is_table


def read(text, form=None, piece=1 << 19):
    data = text if isinstance(text, bytes) else text.encode()
    table = EventTable(data, form)
    parts = [table.decode(data[k : k + piece]) for k in range(table.start, len(data), piece)]
    return table, join_events([*parts, table.decode(b"")]).tolist()


NO_HEADER = "no header: its columns are taken as t,x,y,p"
TWO = [(100, 10, 20, True), (200, 11, 21, False)]
TABLES = {  # text, form, events, size, words in remarks
    "own header": ("t,x@64,y@48,on\r\n100,10,20,1\r\n200,11,21,0\r\n", {}, TWO, (64, 48), []),
    "header in another order": ("t,y,x,p\n100,20,10,1\n200,21,11,0\n", {}, TWO, None, ["taken as us"]),
    "header x,y,p,t": ("x,y,p,t\n10,20,1,100\n11,21,0,200\n", {}, TWO, None, ["taken as us"]),
    "header with seconds": (
        "timestamp,x,y,polarity\n1468939802.123456,10,20,1\n1468939802.123457,11,21,-1",
        {}, [(1468939802123456, 10, 20, True), (1468939802123457, 11, 21, False)], None, ["taken as s"],
    ),
    "events.txt of RPG": (
        "0.003811000 33 39 1\n0.003812000 96 133 0\n", {}, [(3811, 33, 39, True), (3812, 96, 133, False)], None,
        [NO_HEADER, "taken as s"],
    ),
    "width and height": ("240 180\n0.0001 10 20 1\n0.0002 11 21 0\n", {}, TWO, (240, 180), [NO_HEADER, "taken as s"]),
    "semicolons, words, floats": ("t_us;x;y;p\n100.0;10.0;20.0;True\n200.0;11.0;21.0;False\n", {}, TWO, None, []),
    "tabs, nanoseconds": ("time [ns]\tx\ty\tpol\n99600\t10\t20\t1\n200499\t11\t21\t-1\n", {}, TWO, None, []),
    "index and label": (",x,y,p,t_us,what\n0,10,20,1,100,a\n1,11,21,0,200,b\n", {}, TWO, None, []),
    "numpy's": ("# t x y p\n1.0e+02 1.0e+01 2.0e+01 1.0e+00\n2.0e+02 11 21 0.0\n", {}, TWO, None, ["taken as us"]),
    "byte order mark, empty lines": (
        b"\xef\xbb\xbft_us, x, y, p\n\n100, 10, 20, 1\n#\n200, 11, 21, 0", {}, TWO, None, [],
    ),
    "order given": (
        "10,20,1,100\n11,21,0,200\n", {"columns": "x,y,p,t", "time_unit": "us"}, TWO, None, [],
    ),
    "unit given": ("t,x,y,p\n.1,10,20,1\n.2,11,21,0\n", {"time_unit": "ms"}, TWO, None, []),
    "given before the header": ("t,y,x,p\n100,10,20,1\n200,11,21,0\n", {"columns": "t,x,y,p"}, TWO, None, ["us"]),
    "times that go back": ("100,10,20,1\n50,11,21,0\n", {}, [TWO[0], (50, 11, 21, False)], None, [NO_HEADER, "us"]),
    "large": ("t_us,x,y,p\n9007199254740993,0,65535,1\n", {}, [(9007199254740993, 0, 65535, True)], None, []),
}  # fmt: skip


@pytest.mark.parametrize("piece", [1, 7, 1 << 19])
@pytest.mark.parametrize("name", TABLES)
def test_the_usual_tables_are_read_and_assumptions_are_remarks(name, piece):
    text, form, events, size, words = TABLES[name]
    table, got = read(text, TableForm(**form), piece)
    assert (got, table.damage, table.size) == (events, "", size)
    assert len(table.remarks) == len(words)
    for remark, word in zip(table.remarks, words, strict=True):
        assert word in remark


@pytest.mark.parametrize(
    ("text", "form", "words"),
    [
        ("10,20,1,100\n11,21,0,200\n", {}, "no header, and column 4 has 100, which is no p: .*--columns"),
        ("10,20,70000,1\n11,21,70001,0\n", {}, "column 3 has 70000, which is no y"),
        ("1,2,3,4,5\n", {}, "no header and 5 columns.*--columns"),
        ("a,b,c,d\n1,2,3,4\n", {}, "its header names a, b, c, d: t, x, y and p are needed"),
        ("t,x,y,p,t\n1,2,3,1,5\n", {}, "each once"),
        ("1,2,3,1\n", {"columns": "t,x,y,q"}, "--columns names t, x, y, q"),
        ("1,2,3,1\n", {"columns": "t,x,y,p,q"}, "--columns has 5 names, and its first line 4 columns"),
        ("1,2,3,1\n", {"time_unit": "min"}, "one of s, ms, us, ns"),
        ("1700000000123456789,2,3,1\n", {}, "--time-unit ns"),
        ("t,x,y,p\n\0\n", {}, "no text"),
        ("\n\n", {}, "no line of an event"),
        ("[1, 2, 3, 4]\n", {}, r"column 1 has \[1, which is no t"),
    ],
)
def test_a_table_whose_columns_are_not_clear_is_refused_before_its_first_event(text, form, words):
    with pytest.raises(ValueError, match=words):
        EventTable(text.encode(), TableForm(**form))


@pytest.mark.parametrize("piece", [5, 1 << 19])
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("bad,3,3,0", "t is 'bad', not a time"), ("300,3.5,3,0", "x is '3.5', not a whole number"),
        ("300,3,70000,0", "y is '70000'"), ("300,3,3,7", "p is '7', not one of 0 and 1"), ("-1,3,3,0", "t is '-1'"),
        ("300,3,3", "it has 3 columns, not 4"), ("300,3,3,0,0", "5 columns"), ("nan,3,3,0", "t is 'nan'"),
        ("300,3,3,-1", "p is -1, and 0 in lines before it"), ("300.5,3,3,0", "t is 300.5, which is no whole number"),
        ("1e300,3,3,0", "t is '1e300'"), ("300,,3,0", "x is ''"), ("300,1_0,3,0", "x is '1_0'"),
    ],
)  # fmt: skip
def test_all_lines_before_a_bad_one_are_returned_and_its_place_is_named(line, words, piece):
    table, got = read(f"t,x,y,p\n100,10,20,1\n\n200,11,21,0\n{line}\n400,4,4,1\n", piece=piece)
    assert got == TWO
    assert table.damage.startswith("line 5: ")
    assert words in table.damage


def test_a_line_without_an_end_takes_no_more_memory():
    table = EventTable(b"t,x,y,p\n1,2,3,1\n")
    for _ in range(40):
        table.decode(b"1" * 4096)
    assert "line 2: it has more than 65536 octets" in table.damage
    assert len(table.rest) <= 65536 + 4096


EVENTS = st.lists(
    st.tuples(st.integers(0, 1 << 50), st.integers(0, 65535), st.integers(0, 65535), st.booleans()), min_size=1
)


@given(EVENTS, st.permutations("txyp"), st.sampled_from([",", ";", " ", "\t", ", "]), st.integers(1, 300))
def test_any_events_in_any_columns_come_back_whatever_the_pieces(events, order, separator, piece):
    places = ["txyp".index(name) for name in order]
    rows = (separator.join(str(int(event[k])) for k in places) for event in events)
    table, got = read("\n".join(rows), TableForm(",".join(order), "us"), piece)
    assert (got, table.damage) == (events, "")


@given(
    st.lists(st.sampled_from("0123456789,; \n\t\r-.etxyp#@é")),
    st.binary(max_size=50),
    st.integers(1, 50),
)  # fmt: skip
def test_any_text_is_read_or_refused(characters, octets, piece):
    data = "".join(characters).encode() + octets
    for form in (TableForm(), TableForm("t,x,y,p", "us"), TableForm("p,q,y,x,t", "s")):
        try:
            _, got = read(data, form, piece)
        except ValueError:
            continue
        assert len(np.array(got, EVENT)) <= len(data)


@pytest.mark.parametrize(
    ("text", "right"),
    [
        ("x,y,p,t\n", True), ("240 180\n0.1 1 2 1\n", True), ("1 2 3 1\n", True), ("1,2,3,4,5\n", True),
        ("hello world\n", False), ("schema = 1\n[camera]\nmodel = 'x'\n", False), ("[1, 2, 3, 4]\n", False),
        ("solid a\n facet normal 0 0 1\n", False), ("{}\n", False), ("# a comment\n", False),
    ],
)  # fmt: skip
def test_a_table_is_recognised_by_its_first_lines(text, right):
    assert is_table(text.encode()) is right
