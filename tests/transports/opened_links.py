"""A link of a rig in its process, without the run, and what its reports must come to."""

import dataclasses
import time

from emulator.rig.loading import parse_rig
from emulator.run.assembly import link_setups
from emulator.run.link_process import LinkProcess
from transports.link.pacing import MonotonicClock
from transports.link.rings import EventRing

__all__ = ["balanced", "opened", "wait_until"]


def opened(table, more=""):
    """Return the ready process of a link with this table, in a rig with `more` tables."""
    loaded = parse_rig(f'[scene]\nkind = "checkerboard"\n{more}\n[[links]]\n{table}\n', "a.toml", "a")
    (setup,) = link_setups(loaded)
    link = LinkProcess(dataclasses.replace(setup, ring=EventRing(1 << 21)), MonotonicClock())
    link.wait_ready()
    return link


def wait_until(link, told):
    """Wait for a report that `told` is true of."""
    until = time.monotonic() + 120
    while not told(link.listen()):
        assert time.monotonic() < until, link.report
        time.sleep(0.01)


def balanced(report, count):
    """Assert that each of `count` events has a fate."""
    assert report.error is None
    assert report.delivered + report.dropped + report.dropped_in_device == count
    assert report.camera.queued == 0
