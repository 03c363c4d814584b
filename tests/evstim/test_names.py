"""The public names of evstim: those of the reference, that all can be used, and that none costs anything unused."""

import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest

import evstim

REFERENCE = (Path(__file__).parents[2] / "docs/python.md").read_text(encoding="utf-8").partition("\n## Reference")[2]
NAMES = {
    *re.findall(r"^::: evstim\.(\w+)", REFERENCE, re.MULTILINE),
    *re.findall(r"`(?:evstim\.)?([A-Z]\w*)`", REFERENCE),
}

HEAVY = ("numpy", "numba", "scipy", "moderngl", "trimesh", "can", "serial", "usb", "msgspec", "emulator", "matplotlib")


def test_the_public_names_are_those_of_the_reference():
    assert sorted(evstim.__all__) == sorted(NAMES)
    assert [name for name in dir(evstim) if not name.startswith("__")] == sorted(NAMES)


def test_the_version_is_that_of_the_installed_package():
    assert evstim.__version__ == importlib.metadata.version("evstim")
    assert "__version__" in dir(evstim)


def test_each_name_can_be_imported():
    values = {name: getattr(evstim, name) for name in NAMES}
    assert [name for name, value in values.items() if value is None or value is not getattr(evstim, name)] == []


def test_type_checkers_see_the_same_names():
    assert sorted(evstim.__all__) == sorted(evstim._sources())


def test_a_name_that_is_not_there():
    with pytest.raises(AttributeError, match="no attribute 'Sensr'"):
        evstim.Sensr  # noqa: B018


def in_a_process(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    return done.stdout


def test_import_loads_nothing_heavy():
    code = f"import sys, evstim; print([m for m in {(*HEAVY, 'importlib.metadata')!r} if m in sys.modules])"
    assert in_a_process(code).strip() == "[]"


def loaded_by(program):
    """Return the modules that a program has loaded when it ends."""
    code = (
        "import atexit, sys\n"
        "atexit.register(lambda: print(*sys.modules, file=sys.stderr))\n"
        f"sys.argv = {program!r}\n"
        "import runpy\n"
        "runpy.run_module(sys.argv[0], run_name='__main__')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    return done.stderr.split()


def test_help_loads_little():
    """Its time is that of its imports: no parts of the program but the command line, and no log handler of rich."""
    loaded = loaded_by(["evstim", "--help"])
    own = [name for name in loaded if name.startswith(("emulator.", "transports.", "firmware_protocol."))]
    assert "emulator.cli.app" in own
    assert len(own) <= 15
    assert not {*HEAVY, "rich.logging", "rich.traceback"} - {"emulator"} & set(loaded)


def test_a_receiver_needs_no_simulator():
    used = "evstim.EVENT, evstim.ClockEstimator"
    code = f"import sys, evstim; {used}; print('numba' in sys.modules, 'emulator' in sys.modules)"
    assert in_a_process(code).split() == ["False", "False"]


EXTRAS = ("av", "PIL", "faery", "h5py", "rosbags", "cyclonedds", "matplotlib", "fmpy", "spiceypy", "pyarrow", "dask")


def test_no_name_needs_an_extra():
    """Each extra is imported by the function that uses it."""
    code = f"""
import sys
for extra in {EXTRAS!r}:
    sys.modules[extra] = None  # importing it raises ImportError
import evstim
print([name for name in evstim.__all__ if getattr(evstim, name) is None])
"""
    assert in_a_process(code).strip() == "[]"
