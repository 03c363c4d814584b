"""Events for tests: at given times, elsewhere zero, or anywhere on a sensor."""

import numpy as np

from firmware_protocol.events import EVENT
from firmware_protocol.imu_samples import no_samples

__all__ = ["events_at", "events_of", "samples_at", "scattered", "steady"]


def events_at(times, **columns):
    """Return events, (n,) EVENT, at times, us, (n,); `columns` that are not given are zero."""
    events = np.zeros(len(times), EVENT)
    events["t"] = times
    for name, values in columns.items():
        events[name] = values
    return events


def events_of(*rows):
    """Return (t, x, y, on) rows as EVENT."""
    return np.array(list(rows), EVENT)


def samples_at(times, counts, scale=0xEA):
    """Return samples of an inertial unit at times, us, (n,), with counts, (n, 7)."""
    samples = no_samples(len(times))
    samples["t"], samples["scale"], samples["counts"] = times, scale, counts
    return samples


def scattered(times, size=(346, 260), seed=1):
    """Return events at times, us, (n,), anywhere on a sensor of size (width, height), of any polarity."""
    x, y, on = np.random.default_rng(seed).integers(0, (*size, 2), (len(times), 3)).T
    return events_at(times, x=x, y=y, on=on)


def steady(n, start_us=0, step_us=1, seed=0, size=(346, 260)):
    """Return `n` scattered events, one each `step_us`."""
    return scattered(start_us + step_us * np.arange(n), size, seed)
