"""Row kicks: reading a line of active pixels disturbs its event pixels for a moment.

A read adds a small value to the signal of the line's event pixels. A pixel whose level is within this value of its ON
threshold fires then, instead of later: afterwards it behaves as if it had crossed the threshold by itself. So every
leak event of a still pixel comes at a read, and events of a rising light come in bursts at the reads of their line,
with fewer after them.

Source: one recording of a DAVIS346 (2.36 s, 59 frames). In still pixels 373 of 376 events lie within 22 us of a read of
their own row; 10.4 % of all ON events within 20 us. They begin 12 us before the reset read and 28 us before the signal
read of their row, and end 35 us later, when the next row is read. Within this time those of still pixels are spread
evenly, those of active ones decay. Here a pixel that needs the share s of the kick has its event at an even chance
between the kick and s times 35 us later: a still pixel drifts towards its threshold so slowly that it needs nearly all
of a kick (s = 1), an active one has any s, which gives the density -ln(t / 35 us). The added value is 0.10 of the ON
threshold; that of signal reads is a little larger, because in stillness the larger one always comes first. The still
pixels' events of a frame vary with Fano factor 1.9, in bright and in dim pixels together: the drift from frame to frame
is 1e-4 of a threshold, so a common variation of the kick of that size makes events come in some frames only.

Levels at a kick lie on the straight line between those at both ends of the step. Pixels that start within reach of a
kick have been kicked by the frames before the start: their first kick sends no event.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.sensor.numerics.keyed import Purpose, normal, uniform
from emulator.sensor.parameters import KickParameters
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, merged
from emulator.sensor.pixels.state import Levels
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Float32s, Floats, Int64s, Mask

_RESET, _SIGNAL = 0, 1
_OF_FRAMES = 1 << 40  # index of their strengths, beyond those of pixels, in us
_STRONG = 2  # deviations of the strongest of the frames before the start
_LEAST = 1e-12  # where frames do not disturb events


@dataclass(frozen=True)
class LineReads:
    """Reads that disturb a step, arrays (n,).

    Attributes
    ----------
    t_ns : times of their kicks.
    line : lines of the user's image.
    signal : True for signal reads.
    frame : numbers of their frames.
    by_column : lines are columns.
    """

    t_ns: Int64s
    line: Int64s
    signal: Mask
    frame: Int64s
    by_column: bool = False

    def only(self, *, signal: bool) -> LineReads:
        """Return the reads of one kind."""
        return self._chosen(self.signal == signal)

    def between(self, t0_ns: int, t1_ns: int) -> LineReads:
        """Return the reads whose kicks come from `t0_ns` on and before `t1_ns`."""
        return self._chosen((self.t_ns >= t0_ns) & (self.t_ns < t1_ns))

    def _chosen(self, mask: Mask) -> LineReads:
        return LineReads(self.t_ns[mask], self.line[mask], self.signal[mask], self.frame[mask], self.by_column)

    def pixels(self, width: int, height: int) -> tuple[Int64s, Int64s]:
        """Return the pixels of all lines, and the read of each one, (n * length,)."""
        along = np.arange(height) * width if self.by_column else np.arange(width)
        first = self.line if self.by_column else self.line * width
        pixel = (first[:, None] + along).reshape(-1)
        return pixel, np.repeat(np.arange(len(self.line)), len(along))


@dataclass(frozen=True)
class _Before:
    """The pixels that are kicked in a step, times and values of their kicks, and their levels at its start."""

    pixel: Int64s
    t_ns: Int64s
    added: Floats
    level: Float32s


class RowKicks:
    """Effect of the reads of active pixels on the events of an array."""

    def __init__(self, kicks: KickParameters, sensor: SensorParameters, seed: int, levels: Levels) -> None:
        self._size = sensor.width, sensor.height
        self._delay_ns = kicks.delay_us * 1000
        self._frame_spread = kicks.frame_spread
        self._seed = seed
        self._levels = levels
        pixels = np.arange(sensor.width * sensor.height)
        excess = kicks.signal_excess / 2
        self._added = [
            (kicks.share * sensor.threshold_on * (1 + side + kicks.spread * normal(seed, Purpose.APS_KICK, pixels, k)))
            for k, side in ((_RESET, -excess), (_SIGNAL, excess))
        ]
        self._late = NO_CROSSINGS
        self._place = np.full(len(pixels), -1, np.int64)
        self._silent = np.zeros(len(pixels), np.bool_)

    def reset(self) -> None:
        """Start with the levels that the pixels have now; no event is to come."""
        pixels = np.arange(len(self._silent))
        on, _ = self._levels.thresholds(pixels)
        strongest = np.maximum(*self._added) * (1 + _STRONG * self._frame_spread)
        self._silent = self._levels.of(pixels) + strongest >= on
        self._late = NO_CROSSINGS

    def begin(self, reads: LineReads) -> list[_Before]:
        """Store the levels at a step's start of all pixels that are read in it."""
        groups = []
        for kind in (_RESET, _SIGNAL):
            lines = reads.only(signal=kind == _SIGNAL)
            if len(lines.t_ns):
                pixel, read = lines.pixels(*self._size)
                pixel, first = np.unique(pixel, return_index=True)
                read = read[first]
                spread = normal(self._seed, Purpose.APS_KICK, lines.frame, _OF_FRAMES + kind)
                added = self._added[kind][pixel] * (1 + self._frame_spread * spread)[read]
                groups.append(_Before(pixel, lines.t_ns[read], added, self._levels.of(pixel)))
        return groups

    def end(self, groups: list[_Before], crossings: Crossings, t0_ns: int, t1_ns: int) -> Crossings:
        """Return a step's crossings with the effect of the reads; some events may come in a later step."""
        for group in groups:
            crossings = self._kicked(group, crossings, t0_ns, t1_ns)
        self._silent[crossings.pixel] = False
        if not len(self._late) and not groups:
            return crossings
        crossings, self._late = merged(crossings, self._late), NO_CROSSINGS
        inside = int(np.searchsorted(crossings.t_ns, t1_ns))
        self._late = _part(crossings, np.arange(inside, len(crossings)), 0)
        return _part(crossings, np.arange(inside), crossings.lost_in_pixel)

    def rest(self) -> Crossings:
        """Return the events that are still to come."""
        late, self._late = self._late, NO_CROSSINGS
        return late

    def _kicked(self, group: _Before, crossings: Crossings, t0_ns: int, t1_ns: int) -> Crossings:
        on, off = self._levels.thresholds(group.pixel)
        self._place[group.pixel] = np.arange(len(group.pixel))
        place = self._place[crossings.pixel]
        self._place[group.pixel] = -1
        at = np.flatnonzero(place >= 0)
        place = place[at]
        moved = np.where(crossings.on[at], on[place], -off[place])
        before = crossings.t_ns[at] <= group.t_ns[place]
        self._silent[crossings.pixel[at[before]]] = False
        n = len(group.pixel)
        until_read, in_all = (np.bincount(place, moved * chosen, n) for chosen in (before, np.ones(len(at))))
        share = (group.t_ns - t0_ns) / (t1_ns - t0_ns)
        rise = self._levels.of(group.pixel) + in_all - group.level
        level = group.level + share * rise - until_read
        missing = on - level
        fired = np.flatnonzero(missing <= group.added)
        needed = np.maximum(missing[fired], 0) / np.maximum(group.added[fired], _LEAST)
        crossings = self._without_next(group, fired, crossings, at[~before], place[~before])
        return merged(crossings, self._events(group, fired, needed))

    def _without_next(
        self, group: _Before, fired: Int64s, crossings: Crossings, later: Int64s, place: Int64s
    ) -> Crossings:
        """Fire the pixels `fired` of a group, and take away their next event in the step if that is an ON event.

        `later` are the crossings of the group after its kicks, `place` those of their pixels in the group.
        """
        places, first = np.unique(place, return_index=True)
        following = np.full(len(group.pixel), -1, np.int64)
        following[places] = later[first]
        instead = following[fired]
        instead = instead[instead >= 0]
        instead = instead[crossings.on[instead]]
        has_own = np.isin(group.pixel[fired], crossings.pixel[instead])
        self._levels.fire(group.pixel[fired][~has_own])
        kept = np.ones(len(crossings), np.bool_)
        kept[instead] = False
        return _part(crossings, np.flatnonzero(kept), crossings.lost_in_pixel)

    def _events(self, group: _Before, fired: Int64s, needed: Floats) -> Crossings:
        """Return the events of the pixels `fired`, which need a share of their kick each; none of silent ones."""
        sent = ~self._silent[group.pixel[fired]]
        self._silent[group.pixel[fired]] = False
        fired, needed = fired[sent], needed[sent]
        pixel, at_ns = group.pixel[fired], group.t_ns[fired]
        chance = uniform(self._seed, Purpose.APS_KICK, pixel, at_ns // 1000 + 2)  # 0 and 1 are the strengths
        t_ns = at_ns + (chance * needed * self._delay_ns).astype(np.int64)
        order = np.lexsort((pixel, t_ns))
        return Crossings(t_ns[order], pixel[order].astype(np.uint32), np.ones(len(order), np.bool_))


def _part(crossings: Crossings, index: Int64s, lost: int) -> Crossings:
    return Crossings(crossings.t_ns[index], crossings.pixel[index], crossings.on[index], lost)
