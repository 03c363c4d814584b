"""Ledger of the time of tests: processor and wall seconds of each file, with compiled kernels apart.

    worker      each test: seconds from its set-up to its tear-down, as a property of its last report
    controller  the sums of each file, in .cache/test-times/PART.json; PART is in the environment as TEST_PART

Processor time includes that of child processes that have ended. The rest of a worker's time (imports, fixtures of a
session) is the file "start and end". `.ci/times.py` prints the parts of `make test` and compares them with a budget.
"""

import json
import os
import resource
import sys
import time
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / ".cache" / "test-times"
REST = "start and end"
PROPERTY = "seconds"

Seconds = dict[str, float]


def _processor_s():
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


class TimeLedger:
    """Plugin of pytest, in the controller and in each worker."""

    def __init__(self, part):
        self._part = part
        self._files = {}
        self._began = {}
        self._tests = {}
        self._compilation = None
        self._start = self._now()

    def _now(self):
        """Return the seconds so far; numba counts its compilations from the first call after its import."""
        event = sys.modules.get("numba.core.event")
        if self._compilation is None and event is not None:
            self._compilation = event.TimingListener()
            event.register("numba:compile", self._compilation)
        compiled = self._compilation.duration if self._compilation and self._compilation.done else 0.0
        return {"processor": _processor_s(), "wall": time.monotonic(), "compiled": compiled}

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_setup(self, item):
        """Begin to count."""
        self._began = self._now()
        return (yield)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_teardown(self, item):
        """Leave the seconds of a test in its last report."""
        try:
            return (yield)
        finally:
            item.user_properties.append((PROPERTY, _difference(self._now(), self._began)))

    def pytest_runtest_logreport(self, report):
        """Add the seconds of a test to those of its file."""
        if report.when == "teardown":
            seconds = dict(report.user_properties).get(PROPERTY, {})
            _add(self._files.setdefault(report.location[0], {}), seconds)
            _add(self._tests, seconds)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session):
        """Send the rest of a worker's time to the controller, or write the file."""
        rest = _difference(_difference(self._now(), self._start), self._tests)
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput[PROPERTY] = rest
            return
        if session.config.getoption("numprocesses", None) is None:
            _add(self._files.setdefault(REST, {}), rest)
        FOLDER.mkdir(parents=True, exist_ok=True)
        (FOLDER / f"{self._part}.json").write_text(json.dumps(self._files, indent=1, sort_keys=True))

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        """Add the rest of a worker's time."""
        _add(self._files.setdefault(REST, {}), getattr(node, "workeroutput", {}).get(PROPERTY, {}))


def _difference(last, first):
    return {name: last[name] - first.get(name, 0.0) for name in last}


def _add(sums, seconds):
    for name, value in seconds.items():
        sums[name] = round(sums.get(name, 0.0) + value, 3)


def pytest_configure(config):
    """Keep a ledger where the run is a part of `make test`."""
    if part := os.environ.get("TEST_PART"):
        config.pluginmanager.register(TimeLedger(part), "time ledger")
