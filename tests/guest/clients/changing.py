"""What the clients that change settings share: one change after another while all streams run, then a settled part.

    settings_*.py --count N --timeout S --output FILE.npz --imu --frames --triggers

The last line has, beside what `collecting` says, `changes`: of each its name, how it failed (null: it did not), and how
much of each stream came until the next. What is saved is the settled part alone.
"""

import sys
import time
from collections.abc import Callable
from functools import partial

from collecting import Collector, arguments

Change = tuple[str, Callable[[], object]]
Take = Callable[[], object]

FAILURES = (AssertionError, OverflowError, RuntimeError, TypeError, ValueError)  # of the drivers, and of the checks
CHANGE_US = 10_000  # device time from change to change: a packet of the drivers of iniVation
CHANGE_S = 0.25  # and host time, should no events come
FRAMES = 4  # of the settled part
SETTLE_US = 700_000  # longer than a frame and the drivers' queues


def read_on(take, collector, for_us, for_s):
    """Take packets until events have come for so long by the device's time, or no longer than `for_s`."""
    from_us, deadline = collector.last_t, time.monotonic() + for_s
    while time.monotonic() < deadline and collector.last_t - from_us < for_us:
        take()


def look(getters):
    """Call each getter and return those that failed, and how."""
    failed = []
    for name, getter in getters:
        print(f"look: {name}", file=sys.stderr, flush=True)
        try:
            getter()
        except FAILURES as failure:
            failed.append({"name": name, "error": f"{type(failure).__name__}: {failure}"})
    return failed


def make_changes(changes, take, collector):
    """Make the changes while the streams run and return what came of each."""
    outcomes = []
    for name, change in changes:
        before, error = collector.counts, None
        print(f"change: {name}", file=sys.stderr, flush=True)  # what the driver logs then follows its cause
        try:
            change()
        except FAILURES as failure:
            error = f"{type(failure).__name__}: {failure}"
        read_on(take, collector, CHANGE_US, CHANGE_S)
        came = {stream: count - before[stream] for stream, count in collector.counts.items()}
        outcomes.append({"name": name, "error": error, **came})
    return outcomes


def take_settled(take, collector, timeout_s):
    """Let what the last changes did pass by, then collect as many events as were asked for, and some frames.

    A driver may be further with its frames than with its events.
    """
    read_on(take, collector, SETTLE_US, timeout_s)
    collector.restart()
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline and not (collector.done and collector.counts["frames"] >= FRAMES):
        take()


def change_values(client, values):
    """Open a camera of iniVation's by its client, set values of its setters while all streams run, and read on."""
    options = arguments()
    collector = Collector(options)
    seen = {"discovered": client.discovered()}
    camera = client.open_camera(options)
    take_some = partial(client.take, camera, collector, options)
    while not collector.counts["events"]:
        take_some()
    setters = [(name, value) for name, some in values.items() for value in some]
    changes = ((f"{name} = {value}", partial(getattr(camera, f"set{name}"), value)) for name, value in setters)
    outcomes = make_changes(changes, take_some, collector)
    while not collector.done and camera.isRunning():
        take_some()
    seen |= {"running": camera.isRunning(), "changes": outcomes}
    del camera, take_some, changes
    collector.report(**seen)


def change_all(camera, take, planned, getters, collector):
    """Change everything of a camera of iniVation's, collect a settled part, and return what came of it."""
    options = arguments()

    def take_some():
        if not camera.isRunning():
            raise ConnectionError("the camera is gone")
        take(camera, collector, options)

    outcomes = make_changes(planned, take_some, collector) + look(getters)
    take_settled(take_some, collector, options.timeout)
    return outcomes
