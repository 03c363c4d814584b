"""FMUs that gcc builds of `falling.c`, once for all tests."""

import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[3] / "examples" / "fmu"))

from build import built


@pytest.fixture(scope="session")
def falling(tmp_path_factory):
    """Return the FMU of a version of FMI, 2 or 3."""
    pytest.importorskip("fmpy", reason="needs the extra fmu")
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    folder = tmp_path_factory.mktemp("fmu")
    made = {version: built(folder, version) for version in (2, 3)}
    return made.__getitem__
