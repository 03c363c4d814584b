"""Tables within tables: kinds, lists, and which key is to blame."""

import dataclasses
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import pytest

from emulator.tables.typed_table import TableError, convert


@dataclass(frozen=True)
class Circle:
    kind: ClassVar[str] = "circle"
    radius_m: float = 1.0

    def __post_init__(self):
        if self.radius_m <= 0:
            raise ValueError(f"radius_m is {self.radius_m}: it must be above 0")


@dataclass(frozen=True)
class Square:
    kind: ClassVar[str] = "square"
    side_m: float
    corner: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Line:
    form: Literal["packets", "words"] = "packets"
    profile: Literal["pus-cobs", "csp-kiss"] = "pus-cobs"
    tick: Literal[1, 10] = 1


@dataclass(frozen=True)
class Drawing:
    line: Line = field(default_factory=Line)
    shape: Circle | Square = field(default_factory=Circle)
    others: tuple[Circle | Square, ...] = ()
    frame: Square | None = None


def test_a_table_s_kind_says_what_it_is():
    made = convert({"shape": {"kind": "square", "side_m": 2}}, Drawing)
    assert made.shape == Square(2.0)
    assert isinstance(made.shape.side_m, float)


def test_a_list_of_tables_and_a_table_that_may_be_left_out():
    made = convert({"others": [{"kind": "circle"}, {"kind": "square", "side_m": 1.0}], "frame": {"side_m": 3}}, Drawing)
    assert made == dataclasses.replace(Drawing(), others=(Circle(), Square(1.0)), frame=Square(3.0))


@pytest.mark.parametrize(
    ("table", "path", "message"),
    [
        ({"shape": {"radius_m": 1.0}}, ("shape", "kind"), "'kind' is missing; one of circle, square"),
        ({"shape": {"kind": "circel"}}, ("shape", "kind"), "did you mean 'circle'"),
        ({"shape": {"kind": "circle", "radius_m": -1.0}}, ("shape", "radius_m"), "must be above 0"),
        ({"shape": {"kind": "square"}}, ("shape",), "'side_m' is missing"),
        (
            {"others": [{"kind": "circle"}, {"kind": "circle", "radius_m": "x"}]},
            ("others", 1, "radius_m"),
            "must be a number of m, got 'x'",
        ),
        ({"others": {"kind": "circle"}}, ("others",), "expected a list of tables"),
        ({"others": [3]}, ("others", 0), "expected a table, got 3"),
        ({"frame": {"side_m": 1.0, "corner": [1.0, "x"]}}, ("frame", "corner", 1), "Expected `float`"),
        ({"frame": {"sides_m": 1.0}}, ("frame", "sides_m"), "did you mean 'side_m'"),
        ({"line": {"form": "wrods"}}, ("line", "form"), "'wrods' is not known here; did you mean 'words'\\?$"),
        (
            {"line": {"form": "COBS"}},
            ("line", "form"),
            r"known are packets, words; or is profile = 'pus-cobs' meant\?$",
        ),
        ({"line": {"profile": "words"}}, ("line", "profile"), "or is form = 'words' meant"),
        ({"line": {"tick": "1"}}, ("line", "tick"), "'1' is not known here"),
    ],
)
def test_a_mistake_is_told_with_its_place(table, path, message):
    with pytest.raises(TableError, match=message) as told:
        convert(table, Drawing)
    assert told.value.path == path
