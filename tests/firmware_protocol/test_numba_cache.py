"""numba's cache on disk: used while the sources are the same, ignored unread when they are others."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_protocol.compiled import NO_FOLDER, checksum_of, private_folder

ROOT = Path(__file__).parents[2]

MODULE = """
from typing import NamedTuple
from numba import njit
from firmware_protocol.compiled import valid_for

class {name}(NamedTuple):
    x: float

double = valid_for({checksum}, njit(lambda p: 2 * p.x))
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


HOMELESS = """
import pwd
pwd.getpwuid = lambda user: {}[user]  # as for a user that a container was started with
from firmware_protocol.compiled import cache_folder, entry_of

@entry_of("firmware_protocol.compiled")
def double(x):
    return 2 * x

print(double(4), sum(double.stats.cache_hits.values()), cache_folder(double))
"""


@pytest.fixture
def homeless(tmp_path):
    """Run an entry for a user without home who cannot write its module's folder; return what was printed."""
    (tmp_path / "place").mkdir()
    (tmp_path / "place/entry.py").write_text(HOMELESS)
    (tmp_path / "place/__pycache__").write_text("in the way, also of root")

    def run(folder):
        environment = {"PYTHONPATH": f"{tmp_path / 'place'}:{ROOT}", "TMPDIR": str(folder), "PATH": "/usr/bin:/bin"}
        command = [sys.executable, "-B", "-c", "import entry"]
        options = {"cwd": tmp_path, "env": environment, "timeout": 300, "check": True}
        done = subprocess.run(command, capture_output=True, text=True, **options)
        return done.stdout.split(), done.stderr

    return run


@pytest.mark.system
def test_code_of_a_user_without_home_is_in_a_folder_below_tmpdir(homeless, tmp_path):
    (value, hits_before, folder), _ = homeless(tmp_path)
    assert (value, hits_before) == ("8", "0")
    assert homeless(tmp_path) == (["8", "1", folder], "")
    private = tmp_path / f"evstim-{os.geteuid()}"
    assert Path(folder).parent == private
    assert private.stat().st_mode & 0o777 == 0o700
    assert not (tmp_path / "~").exists()


@pytest.mark.system
def test_without_any_folder_kernels_are_compiled_and_one_sentence_names_the_remedy(homeless, tmp_path):
    assert homeless(tmp_path / "missing") == (["8", "0", "None"], f"{NO_FOLDER}\n")
    assert "XDG_CACHE_HOME" in NO_FOLDER
    assert sorted(path.name for path in tmp_path.iterdir()) == ["place"]


def given_away(folder):
    """Give a folder to another user, which root alone can do."""
    if os.geteuid():
        pytest.skip("only root can give a folder away")
    os.chown(folder, 12345, 12345)


PREPARED = {
    "link": lambda place: (place.with_name("other").mkdir(0o700), place.symlink_to("other")),
    "link to nothing": lambda place: place.symlink_to("nothing"),
    "file": lambda place: place.write_text(""),
    "read by others": lambda place: (place.mkdir(), place.chmod(0o705)),
    "written by a group": lambda place: (place.mkdir(), place.chmod(0o770)),
    "another owner": lambda place: (place.mkdir(0o700), given_away(place)),
}
REPLACED = {
    "by all": lambda folder: folder.chmod(0o777),
    "by a group": lambda folder: folder.chmod(0o775),
    "by its owner": given_away,
}


@pytest.mark.parametrize("how", PREPARED)
def test_a_folder_that_another_user_can_have_prepared_is_refused(how, tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    PREPARED[how](tmp_path / f"evstim-{os.geteuid()}")
    with pytest.raises(PermissionError, match="is no folder of this user alone"):
        private_folder()


@pytest.mark.parametrize("depth", [0, 1])
@pytest.mark.parametrize("how", REPLACED)
def test_a_folder_that_another_user_can_replace_is_not_made(how, depth, tmp_path, monkeypatch):
    folder = tmp_path / "above/below"
    folder.mkdir(0o700, parents=True)
    monkeypatch.setenv("TMPDIR", str(folder))
    REPLACED[how]([folder, folder.parent][depth])
    with pytest.raises(PermissionError, match="other users can replace"):
        private_folder()
    assert not list(folder.iterdir())


def test_a_folder_in_one_that_all_share_is_private(tmp_path, monkeypatch):
    (tmp_path / "shared").mkdir()
    (tmp_path / "shared").chmod(0o1777)
    (tmp_path / "name").symlink_to("shared")
    monkeypatch.setenv("TMPDIR", str(tmp_path / "name"))
    for _ in range(2):
        assert private_folder() == tmp_path / "shared" / f"evstim-{os.geteuid()}"
