"""Rigs with values of any type and size: the loader accepts them or raises RigError, nothing else."""

import copy
import itertools
import random
import tomllib
from contextlib import suppress

from emulator.rig.loading import RigError, parse_rig, shipped_rigs
from emulator.rig.top_level import TOP_LEVEL
from emulator.tables.toml_text import toml_of
from emulator.tables.typed_table import field_types

SHIPPED = {name: tomllib.loads(path.read_text()) for name, path in shipped_rigs().items()}
VALUES = (
    [], ["a"], ["davis346"], [1, 2], [float("nan")] * 3, [True], [{}], [[[]]], {}, {"kind": ["x"]}, {"kind": "fixed"},
    float("nan"), float("inf"), 1e308, -1e308, 1e-300, 10**30, -(10**30), 2**63, -1, 0, True, False,
    "", "é\u202e\U0001f600", "\x1b[31m\x00", "../a/b", "x" * 5000,
)  # fmt: skip
MUTATIONS = 600


def places(value, path=()):
    """Yield the path of every value in a table, and of the tables and lists in it."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in inside:
        yield (*path, key)
        yield from places(one, (*path, key))


def with_value(rig, path, value):
    changed = table = copy.deepcopy(rig)
    for key in path[:-1]:
        table = table[key]
    table[path[-1]] = value
    return changed


def attempt(rig):
    """Load a rig; any exception but RigError fails the test, with the rig beside it."""
    with suppress(RigError):
        parse_rig(toml_of(rig), "rigs/mutated.toml", "mutated")


def test_a_shipped_rig_with_any_value_in_any_place_loads_or_is_refused():
    drawn = random.Random(40)
    everywhere = [(rig, path) for rig in SHIPPED.values() for path in places(rig)]
    for rig, path in drawn.sample(everywhere, min(MUTATIONS, len(everywhere))):
        attempt(with_value(rig, path, drawn.choice(VALUES)))


def test_any_value_of_any_key_loads_or_is_refused():
    drawn, scene = random.Random(41), {"scene": {"kind": "checkerboard"}}
    for name, key in TOP_LEVEL.items():
        for kind, cls in key.kinds().items():
            for field, value in itertools.product(field_types(cls), drawn.sample(VALUES, 2)):
                table = {field: value, **({"kind": kind} if kind else {})}
                attempt({**scene, name: [table] if key.is_list else table})


def test_a_model_that_is_a_list_or_a_table_is_refused():
    for model in (["davis346"], {"name": "davis346"}, 1.5):
        attempt({"scene": {"kind": "checkerboard"}, "camera": {"model": model}})
