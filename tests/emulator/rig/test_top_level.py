"""The top-level keys of a rig: loader, schema and reference have the same ones, and another validator agrees."""

import dataclasses
import json
import tomllib
from pathlib import Path

import jsonschema
import pytest

from emulator.rig.loading import Rig, RigError, parse_rig, shipped_rigs
from emulator.rig.top_level import TOP_LEVEL, rig_schema

ROOT = Path(__file__).parents[3]
SCHEMA = json.loads(json.dumps(rig_schema()))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
EXAMPLES = [
    path
    for path in sorted((ROOT / "examples").rglob("*.toml"))
    if "[scene]" in path.read_text() and not (path.parent / "pyproject.toml").exists()  # which adds kinds of its own
]

BASE = """\
[scene]
kind = "checkerboard"
[[links]]
kind = "loopback"
[[links]]
kind = "can"
name = "bus"
"""

# A table of each key that is right, and one whose value is wrong.
TABLES = {
    "title": ('title = "words"\n', "title = 3\n"),
    "scene": ("", "scene = 3\n"),
    "camera": ('[camera]\nmodel = "davis346"\n', "[camera]\nserial = 5\n"),
    "second_camera": ('[second_camera]\nlinks = ["bus"]\n', '[second_camera]\nlinks = "bus"\n'),
    "trigger": ('[trigger]\nsource = "bus"\n', "[trigger]\nsource = 1\n"),
    "run": ("[run]\nstep_us = 500\n", '[run]\nstep_us = "soon"\n'),
    "verdict": ("[verdict]\nmax_drop = 0.1\n", '[verdict]\nmax_drop = "few"\n'),
    "links": ("", '[[links]]\nkind = "none such"\n'),
    "faults": (
        '[[faults]]\nlink = "bus"\nkind = "lost_frames"\nrate = 0.1\n',
        '[[faults]]\nlink = "bus"\nkind = "lost_frames"\nrate = "half"\n',
    ),
}


def valid(text):
    return VALIDATOR.is_valid(json.loads(json.dumps(tomllib.loads(text))))


def text_of(key, table):
    return table + BASE if key == "title" else table if "scene = 3" in table else BASE + table


def test_every_key_is_tried_here():
    assert set(TABLES) == set(TOP_LEVEL)


def test_a_rig_has_a_field_for_each_key_and_no_other():
    assert {f.name for f in dataclasses.fields(Rig)} == {"name", "source", *TOP_LEVEL}


def test_the_schema_has_each_key_with_its_meaning_and_no_other():
    assert {name: of["description"] for name, of in SCHEMA["properties"].items()} == {
        name: key.meaning for name, key in TOP_LEVEL.items()
    }
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("key", TOP_LEVEL)
def test_loader_and_schema_take_what_is_right_and_refuse_what_is_wrong(key):
    right, wrong = (text_of(key, table) for table in TABLES[key])
    assert getattr(parse_rig(right, "r.toml", "r"), key) is not None
    assert valid(right)
    with pytest.raises(RigError, match=rf"r\.toml, line \d+: {key}"):
        parse_rig(wrong, "r.toml", "r")
    assert not valid(wrong)


def test_a_key_that_is_none_is_refused_by_loader_and_schema():
    text = BASE + "[second_cam]\n"
    with pytest.raises(RigError, match=r"line 8: second_cam: .*did you mean 'second_camera'"):
        parse_rig(text, "r.toml", "r")
    assert not valid(text)


@pytest.mark.parametrize("path", [*shipped_rigs().values(), *EXAMPLES], ids=lambda path: path.stem)
def test_every_shipped_rig_is_valid_by_the_schema(path):
    table = json.loads(json.dumps(tomllib.loads(path.read_text())))
    assert [f"{error.json_path}: {error.message[:200]}" for error in VALIDATOR.iter_errors(table)] == []
