"""Several programs that use one run, one after another: what each returned, and what left the camera in its turn.

A run takes seconds to start, and its record is there at its end. So the tests of a module share a run, and each judges
the turn of its own; a turn that fails is raised by the test that judges it.
"""

from functools import cached_property
from typing import Generic, TypeVar

import pytest

from tests.guest.streaming import Seen

__all__ = ["Turns", "long_but", "parts_of", "selected"]

Name = TypeVar("Name")
Result = TypeVar("Result")

LEAST_START_DELAY_US = 500_000
"""No rig of these tests starts its camera's events sooner; after a timestamp reset they go on at once."""


def long_but(short, values):
    """Return values for a parameter of tests: those not in `short` are for `make long` alone."""
    return [value if value in short else pytest.param(value, marks=pytest.mark.long) for value in values]


def selected(request, parameter):
    """Return the values that a parameter has in those tests of the module that were selected, each once."""
    tests = [item for item in request.session.items if item.path == request.path and hasattr(item, "callspec")]
    values = [test.callspec.params[parameter] for test in tests if parameter in test.callspec.params]
    return [value for k, value in enumerate(values) if value not in values[:k]]


class Turns(Generic[Name, Result]):
    """The turns of a run, which has ended.

    Parameters
    ----------
    rig
        Not started.
    names
        Of the turns, in their order.
    take
        Does one turn, and returns what its test judges.
    """

    def __init__(self, rig, names, take):
        self.rig = rig
        self._names = list(names)
        self._results = []
        with rig:
            for name in names:
                try:
                    self._results.append(take(name))
                except (AssertionError, OSError, RuntimeError) as failure:
                    self._results.append(failure)

    def result(self, name):
        """Return what the turn returned, or raise what it raised."""
        result = self._results[self._names.index(name)]
        if isinstance(result, Exception):
            raise result
        return result

    def delivered(self, name):
        """Return what left the camera for the client of a turn."""
        failed = [result for result in self._results if isinstance(result, Exception)]
        if failed:
            raise AssertionError("which part of the record is whose is not known where a turn failed") from failed[0]
        return self._parts[self._names.index(name)]

    @cached_property
    def _parts(self):
        return parts_of([result for result in self._results if isinstance(result, Seen)], self.rig.delivered.turns)


def parts_of(seen, parts):
    """Return the part of a record that each client must have seen, of all parts in which device time began anew.

    A driver that resets the timestamps as it opens may be late, and throws away what came since the camera's start.
    """
    left, found = list(parts), []
    for view in seen:
        part = left.pop(0)
        if view.driver.adds_host_time and part.events["t"][0] >= LEAST_START_DELAY_US:
            part = left.pop(0)
        found.append(part)
    assert not left, f"device time began anew {len(parts)} times for {len(seen)} clients"
    return found
