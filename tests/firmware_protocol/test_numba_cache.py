"""numba's cache on disk: used while the sources are the same, ignored unread when they are others."""

import subprocess
import sys
from pathlib import Path

import pytest

from firmware_protocol.numba_cache import checksum_of

MODULE = """
from typing import NamedTuple
from numba import njit
from firmware_protocol.numba_cache import valid_for

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
    done = subprocess.run(
        [sys.executable, "-c", "import entry"],
        cwd=folder,
        env={"PYTHONPATH": f"{folder}:{Path(__file__).parents[2]}", "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


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
