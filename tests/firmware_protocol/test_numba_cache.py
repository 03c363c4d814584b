"""numba's cache on disk: used while the sources are the same, ignored unread when they are others."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_protocol.compiled import checksum_of

ROOT = Path(__file__).parents[2]

MODULE = """
from typing import NamedTuple
from numba import njit
from firmware_protocol.compiled import valid_for

class {name}(NamedTuple):
    x: float

double = valid_for({checksum}, njit(cache=True)(lambda p: 2 * p.x))
assert double({name}(1.5)) == 3
print(sum(double.stats.cache_hits.values()))
"""


def hits(folder, checksum, name):
    """Write and import a module of that checksum, whose entry takes a type of that name; return its cache hits."""
    module = folder / "entry.py"
    text = MODULE.format(checksum=checksum, name=name)
    if not module.exists() or module.read_text() != text:
        module.write_text(text)
    return int(output_of("import entry", folder, ROOT))


def output_of(program, *path):
    """Run a program in a process of its own that imports from these folders; return what it printed."""
    done = subprocess.run(
        [sys.executable, "-B", "-c", program],
        cwd=path[0],
        env={"PYTHONPATH": ":".join(map(str, path)), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.long
@pytest.mark.system
def test_code_on_disk_serves_the_same_sources_only(tmp_path):
    assert hits(tmp_path, 1, "Old") == 0
    assert hits(tmp_path, 1, "Old") == 1
    assert hits(tmp_path, 2, "New") == 0, "an index that names a type of older sources must not be read"
    assert hits(tmp_path, 2, "New") == 1


@pytest.mark.parametrize("name", ["a.py", "b/c.py"])
def test_the_checksum_is_that_of_all_sources(tmp_path, name):
    (tmp_path / "b").mkdir()
    for other in ("a.py", "b/c.py", "b/notes.txt"):
        (tmp_path / other).write_text("1")
    before = checksum_of(tmp_path)
    (tmp_path / "b/notes.txt").write_text("2")
    assert checksum_of(tmp_path) == before
    (tmp_path / name).write_text("2")
    assert checksum_of(tmp_path) != before


MANY_KINDS = """
import math
import sys
import numpy as np
from numba import njit
from firmware_protocol.compiled import entry_of, kernel

@kernel
def of_kernel(x):
    return math.erf(x) + math.gamma(1 + x) + 0j ** x

@entry_of("firmware_protocol.compiled")
def mix(values):
    if values[0] < 0:
        raise ValueError("less than 0")
    np.random.seed(3)
    room = np.zeros(len(values))
    for k in range(len(values)):
        room[k] = abs(of_kernel(values[k])) + math.expm1(values[k]) + np.random.normal()
    return np.sort(room), np.dot(room, room), (1, room.sum())

@njit
def later(values):
    return mix(values)[0] + values

values = np.linspace(0.1, 3, 7)
print(mix(values)[0].tolist(), *mix(values)[1:])
try:
    mix(-values)
except ValueError as error:
    print(error)
loaded = sum(mix.stats.cache_hits.values())
functions = "numba.np.polynomial.polynomial_functions" in sys.modules
print(later(values).tolist())
print(loaded, functions)
"""


@pytest.mark.long
@pytest.mark.system
def test_code_on_disk_needs_no_functions_of_numba_and_gives_the_same(tmp_path):
    """Memory, random numbers, BLAS, errors and special functions; then a function is compiled that calls it."""
    (tmp_path / "mixed.py").write_text(MANY_KINDS)
    first, second = (output_of("import mixed", tmp_path, ROOT).splitlines() for _ in range(2))
    assert first[:-1] == second[:-1]
    assert (first[-1], second[-1]) == ("0 True", "1 False")


LOOPS = """
from firmware_protocol.compiled import entry_of
from own.layout import COLUMN

@entry_of({sources})
def column_of(row):
    return row[COLUMN]

print(column_of((10, 11, 12)), sum(column_of.stats.cache_hits.values()))
"""


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize(("sources", "after"), [('"own.loops", "own.layout"', "12 0"), ('"own.loops"', "11 1")])
def test_a_constant_of_a_declared_module_is_frozen_no_longer_than_it_is_true(tmp_path, sources, after):
    """The second case is numba's own rule, which the declaration mends: an old column out of a new layout."""
    for name in ("__init__", "compiled"):
        (tmp_path / "firmware_protocol").mkdir(exist_ok=True)
        shutil.copy(ROOT / f"firmware_protocol/{name}.py", tmp_path / "firmware_protocol")
    (tmp_path / "own").mkdir()
    (tmp_path / "own/loops.py").write_text(LOOPS.format(sources=sources))
    told = []
    for column in (1, 1, 2):
        (tmp_path / "own/layout.py").write_text(f"COLUMN = {column}  # as it is now\n")
        told.append(output_of("import own.loops", tmp_path))
    assert told == ["11 0", "11 1", after]


TWO_ENTRIES = """
import math, os
from firmware_protocol.compiled import entry_of, kernel

SCALE = float(os.environ["SCALE"])

@kernel
def scaled(x):  # too long to be inlined
    return SCALE * ({terms})

@entry_of("firmware_protocol.compiled")
def first(x):
    return scaled(x)

@entry_of("firmware_protocol.compiled")
def second(x):
    return scaled(x)
"""


@pytest.mark.system
def test_an_entry_calls_its_own_functions_where_another_has_some_of_the_same_name(tmp_path):
    """Each of two processes compiles one entry, so both codes define a `scaled` of one name, with other factors."""
    terms = " + ".join(f"0 * math.sin(x + {k})" for k in range(40))
    (tmp_path / "two.py").write_text(TWO_ENTRIES.format(terms=f"x + {terms}"))

    def values(scale, *names):
        calls = ", ".join(f"two.{name}(7.0)" for name in names)
        program = f"import os; os.environ['SCALE'] = '{scale}'; import two; print({calls})"
        return output_of(program, tmp_path, ROOT).split()

    assert values(2, "first") == ["14.0"]
    assert values(3, "second") == ["21.0"]
    assert values(5, "first", "second") == values(5, "second", "first")[::-1] == ["14.0", "21.0"]
