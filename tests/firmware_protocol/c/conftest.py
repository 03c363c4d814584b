"""The C library, compiled once for all its tests."""

import sys
from pathlib import Path

import pytest

from tests.firmware_protocol.c.toolchain import Driver, build_driver

sys.path.insert(0, str(Path(__file__).parent.parent / "telemetry"))


@pytest.fixture(scope="session")
def library(tmp_path_factory):
    """The library under sanitizers: `library(mode, bytes)` returns what it made of them."""
    driver = Driver(build_driver(tmp_path_factory.mktemp("c")))
    yield driver
    assert driver.close() == 0
