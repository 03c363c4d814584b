"""A reader of DAVIS346 words that shares nothing with the package: written from the words in docs/cameras.md.

It is strict where drivers are: times of timestamps and wraps must increase, a row comes before the first column, and
blocks (samples, frames) have no holes. What comes before the first timestamp reset is passed over.
"""

import numpy as np

__all__ = ["FrameWords", "WordReader"]

EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
RESET, RISING, FALLING, PULSE, IMU_START, IMU_END = 1, 3, 2, 4, 5, 7
FRAME_STARTS, FRAME_END, LINES, LINE_END, EXPOSURE_START, EXPOSURE_END = (8, 9), 10, (11, 12), 13, 14, 15


class FrameWords:
    """One frame: its moments in us, the exposure words' number, the region, and (kind, samples) of each line."""

    def __init__(self, start_us):
        self.start_us = start_us
        self.exposure_us = {}
        self.end_us = -1
        self.tens = []
        self.bytes = []
        self.lines = []

    @property
    def exposure_cycles(self):
        """The three words of ten bits, the lowest first."""
        low, middle, high = self.tens
        return low | middle << 10 | high << 20


class WordReader:
    """Takes bytes in any even pieces; gives events as they come and keeps the rest.

    Attributes
    ----------
    time_us : device time of the last timestamp or wrap.
    edges : (time, code) of each.
    samples : (time, scale, bytes) of each.
    frames : those that have ended.
    """

    def __init__(self):
        self.time_us = self._base_us = -1
        self._row = -1
        self.edges = []
        self.samples = []
        self.frames = []
        self._sample = None
        self._frame = None
        self._begun = False

    def feed(self, data):
        """Return the events of `data`, (n,) EVENT in device time since the reset."""
        words = np.frombuffer(data, "<u2").astype(np.int64)
        if not self._begun:
            at = np.flatnonzero(words == RESET)
            if not len(at):
                return np.zeros(0, EVENT)
            words, self._begun, self.time_us, self._base_us = words[at[0] + 1 :], True, 0, 0
        assert not (words == RESET).any(), "another reset"
        times = self._times(words)
        kinds = words >> 12
        self._others(words, times, np.flatnonzero((kinds == 0) | ((kinds >= 4) & (kinds <= 6))))
        return self._events(words, times, kinds)

    def _times(self, words):
        """Device time in force at each word."""
        wrap, stamp = words >> 12 == 7, words >= 0x8000
        base = self._base_us + np.cumsum(np.where(wrap, (words & 0xFFF) << 15, 0))
        timing = wrap | stamp
        told = np.where(stamp, base + (words & 0x7FFF), base)[timing]
        assert (np.diff(told, prepend=self.time_us) > 0).all(), "times do not increase"
        index = np.cumsum(timing)
        times = np.concatenate([[self.time_us], told])[index]
        if len(words):
            self._base_us, self.time_us = int(base[-1]), int(times[-1])
        return times

    def _events(self, words, times, kinds):
        is_row = kinds == 1
        rows = np.concatenate([[self._row], (words & 0xFFF)[is_row]])[np.cumsum(is_row)]
        self._row = int(rows[-1]) if len(rows) else self._row
        column = (kinds == 2) | (kinds == 3)
        events = np.zeros(int(column.sum()), EVENT)
        assert not len(events) or rows[column].min() >= 0, "a column without a row"
        events["t"], events["x"], events["y"] = times[column], words[column] & 0xFFF, rows[column]
        events["on"] = kinds[column] == 3
        return events

    def _others(self, words, times, at):
        for word, t_us in zip(words[at].tolist(), times[at].tolist(), strict=True):
            if word < 0x1000:
                self._special(word, t_us)
            elif self._sample is not None:
                self._sample.append(word)
            else:
                self._of_frame(word)

    def _special(self, code, t_us):
        if code in (RISING, FALLING, PULSE):
            self.edges.append((t_us, code))
        elif code == IMU_START:
            assert self._sample is None
            self._sample = []
        elif code == IMU_END:
            assert self._sample is not None
            scale, *data = self._sample
            assert scale & 0xFF00 == 0x5300
            assert all(word & 0xFF00 == 0x5000 for word in data)
            self.samples.append((t_us, scale & 0xFF, bytes(word & 0xFF for word in data)))
            self._sample = None
        else:
            self._frame_special(code, t_us)

    def _frame_special(self, code, t_us):
        if code in FRAME_STARTS:
            assert self._frame is None
            self._frame = FrameWords(t_us)
            return
        assert self._frame is not None, f"special {code} outside a frame"
        if code in LINES:
            self._frame.lines.append((code, []))
        elif code in (EXPOSURE_START, EXPOSURE_END):
            self._frame.exposure_us[code] = t_us
        elif code == FRAME_END:
            self._frame.end_us = t_us
            self.frames.append(self._frame)
            self._frame = None
        else:
            assert code == LINE_END, f"special {code}"

    def _of_frame(self, word):
        assert self._frame is not None, f"word {word:04x} outside a frame"
        if word >> 12 == 4:
            self._frame.lines[-1][1].append(word & 0xFFF)
        elif word >> 12 == 5:
            self._frame.bytes.append(word & 0xFF)
        else:
            self._frame.tens.append(word & 0x3FF)
