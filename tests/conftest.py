"""What holds for all tests: they judge the code, not how busy the machine is."""

import asyncio
import inspect
import itertools
import multiprocessing
import os
import re
import signal
import sys
from contextlib import ExitStack

import pytest
from _pytest.mark.expression import Expression
from hypothesis import HealthCheck, settings

from tests.shown import pytest_itemcollected, pytest_runtest_logreport, pytest_sessionfinish
from tests.time_ledger import pytest_configure

__all__ = ["pytest_configure", "pytest_itemcollected", "pytest_runtest_logreport", "pytest_sessionfinish"]

_IMPORTED = [
    "transports.can_bus.endpoint",
    "transports.file",
    "transports.gige.endpoint",
    "transports.network_streams.tcp",
    "transports.network_streams.udp",
    "transports.serial_line.endpoint",
    "transports.udp_packets.endpoint",
    "transports.usb.usbip.endpoint",
]

settings.register_profile("quick", max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("deep", settings.get_profile("quick"), max_examples=1000)
settings.load_profile(os.environ.get("EVSTIM_HYPOTHESIS", "quick"))


def pytest_ignore_collect(collection_path, config):
    """Import no file whose tests the option -m leaves out whichever of the markers in its text each of them has."""
    if collection_path.suffix != ".py" or not config.option.markexpr or not collection_path.name.startswith("test_"):
        return None
    expression = Expression.compile(config.option.markexpr)
    text = collection_path.read_text(encoding="utf-8")
    names = {"long"} if "mark.sampled" in text else set()
    names |= {name for name in re.findall(r"\bmark\.(\w+)", text) if name in config.option.markexpr}
    sets = itertools.chain.from_iterable(itertools.combinations(names, count) for count in range(len(names) + 1))
    return None if any(expression.evaluate(lambda name, **_: name in some) for some in sets) else True  # noqa: B023


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Leave all but the first parameters of a test with the marker `sampled` to `make long`."""
    sampled = set()
    for item in items:
        if item.get_closest_marker("sampled"):
            test = item.nodeid.partition("[")[0]
            if test in sampled:
                item.add_marker("long")
            sampled.add(test)


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """Run a test that is a coroutine in an event loop of its own."""
    if not inspect.iscoroutinefunction(test := pyfuncitem.obj):
        return None
    asyncio.run(test(**{name: pyfuncitem.funcargs[name] for name in inspect.signature(test).parameters}))
    return True


@pytest.fixture(autouse=True)
def _signal_handlers():
    """Restore the handlers that a command sets for the rest of its process, which here is that of all tests."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    discarded = sys.unraisablehook
    yield
    sys.unraisablehook = discarded
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def forked_links(monkeypatch):
    """Links are forks of a process that has imported them; `links_as_users_have_them` begins one of each kind anew."""
    of_method, server = multiprocessing.get_context, multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(_IMPORTED)
    monkeypatch.setattr(
        multiprocessing, "get_context", lambda method=None: server if method == "spawn" else of_method(method)
    )


@pytest.fixture
def at_end():
    """An ExitStack that is left with the test."""
    with ExitStack() as stack:
        yield stack


@pytest.fixture(scope="session")
def gl():
    """Skip, with the reason, where there is no GL; in CI that is a failure."""
    from emulator.gl.context import probe  # most tests need no GL, and its import takes time

    report = probe()
    if not report.available:
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(report.reason)
    return report
