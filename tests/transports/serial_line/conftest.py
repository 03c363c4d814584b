"""Lets the tests of this folder share their bench, which importlib mode does not find by itself."""

import asyncio
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from line_bench import Bench


@pytest.fixture
def bench(at_end):
    def make(**settings):
        made = Bench(**settings)
        at_end.callback(lambda: made.closed or made.close())
        asyncio.run(made.open())
        return made

    return make
