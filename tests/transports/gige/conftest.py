"""What the tests of the camera on its sockets share."""

import pytest

from tests.transports.gige.bench import Bench


@pytest.fixture(autouse=True)
def unhurried(monkeypatch):
    """A host that asks for a minute, not for seconds: a busy machine may not let the camera answer sooner."""
    monkeypatch.setattr("transports.gige.host._ATTEMPTS", 120)


@pytest.fixture
def bench():
    made = []

    def make(*faults, **more):
        made.append(Bench(faults, **more))
        return made[-1]

    yield make
    for one in made:
        if not one.loop.is_closed():
            one.close()
