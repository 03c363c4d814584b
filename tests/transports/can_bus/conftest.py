"""What the tests of buses share."""

from types import SimpleNamespace

import pytest


@pytest.fixture
def stamped_by(monkeypatch):
    """Lets a clock that the test moves stamp what the readers of python-can's buses take, which are threads."""

    def stamp(clock):
        module = SimpleNamespace(monotonic_ns=clock.now_ns, time_ns=lambda: 0)  # the age of a message is not known then
        monkeypatch.setattr("transports.can_bus.bus.time", module)

    return stamp
