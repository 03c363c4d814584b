"""The read-out of a scanned sensor, which reads one column after another, over and over.

A pixel that fires holds a request until its column is read, which sends it; crossings until then are lost, and counted.
So a pixel sends at most one event a scan, when its column is read, and the time within a scan sweeps over the columns.

A column takes 1 / width of the scan, or the time of its events on the bus where these are longer: scans become slower
under load. Scans follow each other without a pause from stream time 0 on. A read at time T finds the requests raised up
to and including T only, so the result does not depend on how crossings are divided over calls of `push`.

With `reset.at_acknowledge` the read of its column is a pixel's acknowledge: its crossings before the end of a
refractory period after it are lost too, see `readout`.

Not modelled: a real comparator is sampled at the read only; an excursion that is over by then is lost. Here it is sent.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.sensor.chip.readout import Arrivals, ReadOut, new_busy
from emulator.sensor.numerics.compiled import NONE, cached_entry, kernel, log_compilation
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Bytes, Events, Int64s

_FOREVER_NS = (1 << 63) - 1
_FREE, _OFF, _ON = range(3)

_Requests = Bytes
_Maps = tuple[_Requests, Int64s, Int64s]
"""Requests, (width, height), their number in each column, and the ends of refractory periods: see `new_busy`."""


class _Timing(NamedTuple):
    width: int
    height: int
    column_ps: int
    event_ps: int
    refractory_ns: int  # after the acknowledge


class _Scan(NamedTuple):
    """The next look: its column, its time since the start in ns and ps beyond it; requests that wait; lost ones.

    `busy` are those of pixels in the refractory period after the acknowledge.
    """

    column: int
    t_ns: int
    ps: int
    waiting: int
    lost: int
    busy: int


@kernel
def _idle(scan: _Scan, until_ns: int, timing: _Timing) -> _Scan:
    """Return the scan after whole idle scans, as many as end safely before `until_ns`."""
    scan_ps = timing.column_ps * timing.width
    scans = (until_ns - scan.t_ns) // (scan_ps // 1000 + 1) - 1
    if scans <= 0:
        return scan
    ps = scan.ps + scans * (scan_ps % 1000)
    t_ns = scan.t_ns + scans * (scan_ps // 1000) + ps // 1000
    return _Scan(scan.column, t_ns, ps % 1000, scan.waiting, scan.lost, scan.busy)


@kernel
def _look(scan: _Scan, maps: _Maps, timing: _Timing, out: Events, n: int) -> tuple[int, int]:
    """Send the requests of a column, into `out` from n on; return the new n and the time that this takes, ps."""
    requests, counts, busy_until_ns = maps
    column, t_ns = scan.column, scan.t_ns
    sent = counts[column]
    if sent:
        counts[column] = 0
        for row in range(timing.height):
            if requests[column, row] != _FREE:
                event = out[n]
                event.t = t_ns // 1000
                event.x = column
                event.y = row
                event.on = requests[column, row] == _ON
                requests[column, row] = _FREE
                if busy_until_ns.size > 0:
                    busy_until_ns[row * timing.width + column] = t_ns + timing.refractory_ns
                n += 1
    return n, max(timing.column_ps, sent * timing.event_ps)


@kernel
def _admit(arrivals: Arrivals, k: int, until_ns: int, maps: _Maps, scan: _Scan) -> tuple[int, _Scan]:
    """Turn crossings from k on, up to and including `until_ns`, into requests; return the next k and the scan."""
    requests, counts, busy_until_ns = maps
    _, _, _, waiting, lost, busy = scan
    width = np.uint32(counts.size)
    while k < arrivals.t_ns.size and arrivals.t_ns[k] <= until_ns:
        x, y = arrivals.pixel[k] % width, arrivals.pixel[k] // width
        if busy_until_ns.size > 0 and arrivals.t_ns[k] < busy_until_ns[arrivals.pixel[k]]:
            busy += 1
        elif requests[x, y] == _FREE:
            requests[x, y] = _ON if arrivals.on[k] else _OFF
            counts[x] += 1
            waiting += 1
        else:
            lost += 1
        k += 1
    return k, _Scan(scan.column, scan.t_ns, scan.ps, waiting, lost, busy)


@cached_entry
def _run(
    arrivals: Arrivals, until_ns: int, maps: _Maps, scan: _Scan, timing: _Timing, out: Events
) -> tuple[int, tuple[int, ...]]:
    """Scan until `until_ns`; with no end, until nothing waits. Return the number of events sent, and the scan."""
    n = k = NONE
    size = arrivals.t_ns.size
    while scan.t_ns < until_ns:
        if scan.waiting == 0:
            if k == size and until_ns == _FOREVER_NS:
                break
            scan = _idle(scan, arrivals.t_ns[k] if k < size else until_ns, timing)
        k, scan = _admit(arrivals, k, scan.t_ns, maps, scan)
        before = n
        n, taken_ps = _look(scan, maps, timing, out, n)
        column = scan.column + 1 if scan.column + 1 < timing.width else NONE
        ps = scan.ps + taken_ps
        scan = _Scan(column, scan.t_ns + ps // 1000, ps % 1000, scan.waiting - (n - before), scan.lost, scan.busy)
    _, scan = _admit(arrivals, k, np.int64(_FOREVER_NS), maps, scan)
    return n, scan[0:]


class ScanReadOut(ReadOut):
    """The scan of a sensor, by its size and its `readout` times."""

    def __init__(self, parameters: SensorParameters) -> None:
        super().__init__()
        log_compilation(_run, "the scan")
        times = parameters.readout
        width, height = parameters.width, parameters.height
        event_ps, refractory_ns = max(1, round(times.event_ns * 1000)), round(parameters.refractory_us * 1000)
        self._timing = _Timing(width, height, 1, event_ps, refractory_ns)
        self.set_scan_us(times.scan_us)
        self._maps = np.zeros((width, height), np.uint8), np.zeros(width, np.int64), new_busy(parameters)
        self._queue = _Scan(0, 0, 0, 0, 0, 0)

    def set_scan_us(self, scan_us: float) -> None:
        """Set the time of a scan from the next column on, above 0."""
        self.scan_us = scan_us
        self._timing = self._timing._replace(column_ps=max(1, round(scan_us * 1e6 / self._timing.width)))

    def _serve(self, arrivals: Arrivals, until_ns: int) -> int:
        n, scan = _run(arrivals, until_ns, self._maps, self._queue, self._timing, self._out)
        self._queue = _Scan(*scan)
        return int(n)
