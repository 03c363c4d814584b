from __future__ import annotations

import os

import pytest

from emulator.gl.context import probe


@pytest.fixture(scope="session")
def gl():
    """Skip, saying why, where there is no GL; in CI that is a failure."""
    report = probe()
    if not report.available:
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(report.reason)
    return report
