"""The reference of rig keys: kept in the repository, up to date, and with a meaning for every key."""

import dataclasses
import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_SPEC = importlib.util.spec_from_file_location("rig_reference", ROOT / "docs/rig_reference.py")
rig_reference = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(rig_reference)
TABLES = rig_reference.PAGE.read_text().partition(rig_reference.MARKER)[2].partition("## Presets")[0]
ROWS = [
    [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
    for line in re.sub(r'<h4 id="[^"]+"><code>(\w+)</code></h4>', r"`\1`", TABLES).splitlines()
    if line.startswith("| `")
]


def test_the_page_is_what_the_types_say():
    assert rig_reference.PAGE.read_text() == rig_reference.page(), "run: make docs/rigs.md"


def test_every_key_has_a_meaning_and_a_type_that_a_reader_knows():
    assert len(ROWS) > 300
    for key, kind, _, meaning in ROWS:
        assert len(meaning) > 3, key
        assert not re.search(r"\b_[A-Z]|\bNone\b|Literal|RigFile", kind), (key, kind)


def test_no_text_runs_on_into_another_keys():
    keys = "|".join({key.strip("`") for key, *_ in ROWS if "_" in key or any(c.isdigit() for c in key)})
    run_on = re.compile(rf"\. (({keys})(, \w+)*) [A-Z]")
    assert [(key, meaning) for key, _, _, meaning in ROWS if run_on.search(meaning)] == []


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


@pytest.mark.parametrize("words", ["t_s,x_m,y_m,z_m,qw,qx,qy,qz", "edge_resets", "EVENT[n]"])
def test_the_files_of_rigs_and_runs_are_described(words):
    assert words in (ROOT / "docs/rigs.md").read_text()
