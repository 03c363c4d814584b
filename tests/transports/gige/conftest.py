"""What the tests of the camera on its sockets share."""

import pytest

from tests.transports.gige.bench import Bench


@pytest.fixture(autouse=True)
def unhurried(monkeypatch):
    """A host that asks for a minute, not for seconds: a busy machine may not let the camera answer sooner."""
    monkeypatch.setattr("transports.gige.host._ATTEMPTS", 120)


@pytest.fixture
def bench(at_end):
    def make(*faults, **more):
        made = Bench(faults, **more)
        at_end.callback(lambda: made.loop.is_closed() or made.close())
        return made

    return make
