"""Lets the tests of this folder share their bench, which importlib mode does not find by itself."""

import asyncio
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from line_bench import Bench


@pytest.fixture
def bench():
    made = []

    def make(**settings):
        made.append(Bench(**settings))
        asyncio.run(made[-1].open())
        return made[-1]

    yield make
    for each in made:
        if not each.closed:
            each.close()
