"""The C library, compiled once for all its tests."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from toolchain import Driver, build_driver


@pytest.fixture(scope="session")
def library(tmp_path_factory):
    """The library under sanitizers: `library(mode, bytes)` returns what it made of them."""
    driver = Driver(build_driver(tmp_path_factory.mktemp("c")))
    yield driver
    driver.close()
