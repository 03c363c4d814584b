"""The reference of rig keys: kept in the repository, up to date, and with a meaning for every key."""

import dataclasses
import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
_SPEC = importlib.util.spec_from_file_location("rig_reference", ROOT / "docs/rig_reference.py")
rig_reference = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(rig_reference)
TABLES = rig_reference.PAGE.read_text().partition(rig_reference.MARKER)[2].partition("## Presets")[0]
ROWS = [
    (key, kind, meaning)
    for keys, kind, meaning in re.findall(r"^\|(<h4.+?)\|(.+?)\|(.*)\|$", TABLES, re.MULTILINE)
    for key in re.findall(r"<code>(\w+)</code>", keys)
]


def test_the_page_is_what_the_types_say():
    assert rig_reference.PAGE.read_text() == rig_reference.page(), "run: make docs/rigs.md"


def test_every_key_has_a_meaning_and_a_type_that_a_reader_knows():
    assert len(ROWS) > 300
    for key, kind, meaning in ROWS:
        assert len(meaning) > 3, key
        assert not re.search(r"\b_[A-Z]|\bNone\b|Literal|RigFile", kind), (key, kind)


def test_no_text_runs_on_into_another_keys():
    keys = "|".join({key for key, *_ in ROWS if "_" in key or any(c.isdigit() for c in key)})
    run_on = re.compile(rf"\. (({keys})(, \w+)*) [A-Z]")
    assert [(key, meaning) for key, _, meaning in ROWS if run_on.search(meaning)] == []


def test_a_key_of_a_class_without_a_text_would_be_noticed():
    @dataclasses.dataclass
    class Table:
        """A table.

        Attributes
        ----------
        k1, k2
            Both.
        plain_au
            Alone.
        """

        k1: int
        k2: int
        plain_au: float
        silent: float

    assert rig_reference.meanings(Table) == {"k1": "Both.", "k2": "Both.", "plain_au": "Alone."}
