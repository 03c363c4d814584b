"""The page of cameras and clients: written from outcomes of tests that exist, green only where they passed."""

import ast
import importlib.util
import re
import sys
from pathlib import Path

import pytest

from tests.guest.environments import DRIVERS, EVENTCV

ROOT = Path(__file__).parents[2]
_SPEC = importlib.util.spec_from_file_location("device_matrix", ROOT / "docs/device_matrix.py")
device_matrix = importlib.util.module_from_spec(_SPEC)
sys.modules["device_matrix"] = device_matrix  # dataclasses look their module up
_SPEC.loader.exec_module(device_matrix)
ROWS = device_matrix.load()


def marks_of(file):
    """Return the arguments of the marks `shows` of each function in a file of tests."""
    marked = {}
    for node in ast.walk(ast.parse(file.read_text())):
        for call in getattr(node, "decorator_list", ()):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "pytest.mark.shows":
                marked.setdefault(node.name, []).append([ast.literal_eval(one) for one in call.args])
    return marked


MARKS = {
    f"{file.relative_to(ROOT).as_posix()}::{name}": marks
    for file in (ROOT / "tests").rglob("test_*.py")
    if "mark.shows" in file.read_text()
    for name, marks in marks_of(file).items()
}


def is_of(row, mark):
    """Return whether a row may come from a mark, in which {...} stands for a parameter."""
    camera, client, *what = mark
    words = (re.sub(r"\{[^}]*\}", ".+", word) for word in (camera, client))
    named = zip(words, (row["camera"], row["client"]), strict=True)
    return all(re.fullmatch(word, name) for word, name in named) and what == row["what"]


def test_the_page_is_what_the_outcomes_give():
    assert device_matrix.PAGE.read_text() == device_matrix.page(ROWS), "run: python docs/device_matrix.py"


def test_each_outcome_is_of_a_test_that_declares_it():
    undeclared = [row for row in ROWS if not any(is_of(row, m) for m in MARKS.get(row["test"].partition("[")[0], []))]
    assert undeclared == [], "run these tests with EVSTIM_MATRIX=docs/device_matrix.json (tests/shown.py)"


def test_each_declaration_has_an_outcome():
    tested = {(row["test"].partition("[")[0], *row["what"]) for row in ROWS}
    declared = {(name, *mark[2:]) for name, marks in MARKS.items() for mark in marks}
    assert declared - tested == set(), "run these tests with EVSTIM_MATRIX=docs/device_matrix.json (tests/shown.py)"


def cell(outcomes, column="events"):
    """Return the cell of EVK4, neuromorphic_drivers and a column."""
    rows = [
        {"camera": "evk4", "client": "nd", "what": [column], "test": f"tests/a.py::test_b[{k}]", "outcome": outcome,
         "reason": "its reason", "date": "2026-01-01"}
        for k, outcome in enumerate(outcomes)
    ]  # fmt: skip
    text = device_matrix.page(rows).partition("## Prophesee EVK4 HD")[2]
    table = [line[2:-2].split(" | ") for line in text.partition("\n## ")[0].splitlines() if line[:1] == "|"]
    column_of = table[0].index("neuromorphic_drivers 0.18.2")
    cells = [cells[column_of] for cells in table if cells[0] == device_matrix.COLUMNS[column].heading]
    return (cells or [""])[0], text


@pytest.mark.parametrize(
    ("outcomes", "column", "expected"),
    [
        (["passed"], "events", "exact (1)"),
        (["passed", "skipped"], "settings", "shown (1)"),
        (["passed", "failed"], "events", "**fails** (1)"),
        (["skipped"], "events", "not run (1)"),
        ([], "events", ""),
    ],
)
def test_a_cell_is_green_only_where_a_test_passed_and_none_failed(outcomes, column, expected):
    found, text = cell(outcomes, column)
    assert found == expected
    assert text.count("its reason") == len([one for one in outcomes if one != "passed"])


def test_the_clients_have_the_versions_that_the_tests_install():
    packages = {driver.name: driver.packages[0] for driver in DRIVERS} | {"eventcv": EVENTCV.packages[0]}
    versions = {key: device_matrix.CLIENTS[key].version for key in packages}
    assert versions == {key: package.partition("==")[2] for key, package in packages.items()}
