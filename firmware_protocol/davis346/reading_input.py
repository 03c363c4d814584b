"""Readings on their way into the stream: they wait for their time, and for room where the camera waits on a stall.

    offer -> [waits for its time] -> stream -> host
                   ^-- no room --------+

The registers say which kinds run. A frame whose start came while the camera did not run is left out as a whole, as the
host could not read it.

A frame's start, exposure and end always wait for room, and its lines do where the registers say so. As in the published
logic (APSADCStateMachine: the next frame begins after the end of the one before), a frame whose start finds no room
while parts of an earlier one wait is left out as a whole: a slow host gets fewer frames, not frames with gaps.
"""

from __future__ import annotations

import bisect
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace

from firmware_protocol.davis346.aps_registers import aps_waits_on_stall, frame_settings
from firmware_protocol.davis346.blocks import Block, blocks_of
from firmware_protocol.davis346.imu_registers import imu_settings
from firmware_protocol.davis346.registers import RegisterFile
from firmware_protocol.davis346.settings import Davis346Settings
from firmware_protocol.frame_lines import FrameSettings, LineKind
from firmware_protocol.imu_samples import ImuSettings
from firmware_protocol.readings import ReadingCounters, ReadingKind, Readings

__all__ = ["BlockFates", "ReadingInput"]

_MOST_SAMPLES = 16  # of the inertial unit, that wait for room
_LINES = (LineKind.RESET, LineKind.SIGNAL)
_IMU_WORDS = 1 + 17  # a timestamp, and a sample of all three groups


@dataclass
class BlockFates:
    """How many blocks of each kind met which fate in the stream."""

    flushed: Counter[ReadingKind] = field(default_factory=Counter)
    delivered: Counter[ReadingKind] = field(default_factory=Counter)
    lost: Counter[ReadingKind] = field(default_factory=Counter)
    queued: Counter[ReadingKind] = field(default_factory=Counter)


class ReadingInput:
    """What was offered and is not in the stream yet, and what the registers ask for."""

    def __init__(self, settings: Davis346Settings, registers: RegisterFile) -> None:
        self._settings = settings
        self._registers = registers
        self._longest = {ReadingKind.FRAMES: max(settings.size) + 2, ReadingKind.IMU: _IMU_WORDS}
        self._frames = FrameSettings()
        self._imu = ImuSettings()
        self._waiting: list[Block] = []
        self._held: deque[Block] = deque()
        self._in_frame = self._left_out = False
        self._offered: Counter[ReadingKind] = Counter()
        self._not_running: Counter[ReadingKind] = Counter()
        self._dropped: Counter[ReadingKind] = Counter()
        self._flushed: Counter[ReadingKind] = Counter()

    def follow(self, *, words: bool) -> None:
        """Read the registers again; `words`: whether the data path runs."""
        self._frames = frame_settings(self._registers, self._settings.size, self._settings.layout, words=words)
        self._imu = imu_settings(self._registers, words=words)

    def settings_of(self, kind: ReadingKind) -> tuple[int, ...]:
        """Return what the registers ask of a kind; see `EventDevice.reading_settings`."""
        asked = self._frames if kind is ReadingKind.FRAMES else self._imu
        return tuple(int(n) for n in astuple(asked)) if self.takes(kind) else ()

    def takes(self, kind: ReadingKind) -> bool:
        """Say whether the camera has this kind."""
        return self._settings.frames if kind is ReadingKind.FRAMES else self._settings.imu_unit != 0

    def runs(self, kind: ReadingKind) -> bool:
        """Say whether readings of a kind would go to the host now."""
        return self.takes(kind) and (self._frames.run if kind is ReadingKind.FRAMES else self._imu.run)

    def reserved(self, free_words: int) -> int:
        """Return how many free words are kept for readings in a run that is not paced: half, if any kind runs."""
        return free_words // 2 if any(self.runs(kind) for kind in ReadingKind) else 0

    def room(self, kind: ReadingKind, free_words: int) -> int:
        """Return how many readings of a kind fit what is kept for them."""
        waiting = sum(len(block.words) for block in (*self._held, *self._waiting))
        kinds = sum(self.runs(one) for one in ReadingKind)
        return max(0, (self.reserved(free_words) - waiting) // (self._longest[kind] * max(kinds, 1)))

    def offer(self, kind: ReadingKind, readings: Readings, from_us: int) -> None:
        """Take readings of a kind, (n,); those before `from_us` came while the camera did not run."""
        wanted = readings[readings["t"] >= from_us] if self.runs(kind) else readings[:0]
        blocks = blocks_of(kind, wanted)
        if kind is ReadingKind.FRAMES:
            self._in_frame = self._in_frame and len(blocks) == len(readings)
            blocks = [block for block in blocks if self._is_read(block)]
        self._offered[kind] += len(readings)
        self._not_running[kind] += len(readings) - len(blocks)
        self._waiting = sorted([*self._waiting, *blocks], key=_time_of)

    def _is_read(self, block: Block) -> bool:
        """Say whether a host can read this part of a frame: it has the frame's start, or will have."""
        self._in_frame = self._in_frame or _line_kind(block) == LineKind.START
        return self._in_frame

    def due(self, now_us: int, until_us: int, free_words: int) -> list[Block]:
        """Remove and return the blocks up to `until_us` that may fit `free_words`; the others are held.

        Those that waited beyond their time have that of `now_us`.
        """
        count = bisect.bisect_right(self._waiting, until_us, key=_time_of)
        new, self._waiting = self._waiting[:count], self._waiting[count:]
        passed = deque(block for block in new if self._goes_on(block))
        self._dropped[ReadingKind.FRAMES] += len(new) - len(passed)
        due: list[Block] = []
        for queue in (self._held, passed):
            while queue and len(queue[0].words) <= free_words:
                free_words -= len(queue[0].words)
                due.append(queue.popleft())
            if queue:
                break
        self._hold(passed)
        return [block if block.t_us >= now_us else _dated(block, now_us) for block in due]

    def _goes_on(self, block: Block) -> bool:
        """Say whether this is no part of a frame that was left out."""
        part = _line_kind(block)
        self._left_out = self._left_out and part != LineKind.START
        return part is None or not self._left_out

    def put_back(self, blocks: Sequence[Block]) -> None:
        """Let blocks that were due wait further."""
        self._held.extendleft(reversed(blocks))

    def hold(self, late: Sequence[Block]) -> None:
        """Let blocks that found no room wait further, those that may; the others are dropped."""
        if late:
            blocks, self._held = [*late, *self._held], deque()
            self._hold(blocks)

    def _hold(self, blocks: Iterable[Block]) -> None:
        """Hold blocks behind those that are held; of frames the parts of one, but for lines that may not wait."""
        held = Counter(block.reading.kind for block in self._held) if blocks else Counter()
        lines_wait, left_out = aps_waits_on_stall(self._registers), False
        for block in blocks:
            kind, part = block.reading.kind, _line_kind(block)
            if part == LineKind.START:
                left_out = held[kind] > 0
                self._left_out = self._left_out or left_out
            waits = held[kind] < _MOST_SAMPLES if part is None else not left_out and (lines_wait or part not in _LINES)
            if waits:
                self._held.append(block)
            held[kind] += waits
            self._dropped[kind] += not waits

    def flush(self) -> None:
        """Drop what waits."""
        self._flushed.update(block.reading.kind for block in (*self._held, *self._waiting))
        self._held, self._waiting = deque(), []
        self._in_frame = False

    def counters(self, fates: BlockFates) -> Mapping[str, ReadingCounters]:
        """Return the fates of all that were offered, by kind; `fates` are those in the stream."""
        waiting = Counter(block.reading.kind for block in (*self._held, *self._waiting))
        return {
            str(kind): ReadingCounters(
                offered, self._not_running[kind], self._dropped[kind], self._flushed[kind] + fates.flushed[kind],
                fates.delivered[kind], fates.lost[kind], fates.queued[kind] + waiting[kind],
            )
            for kind, offered in self._offered.items()
        }  # fmt: skip


def _time_of(block: Block) -> int:
    return block.t_us


def _line_kind(block: Block) -> int | None:
    """Return the `LineKind` of a part of a frame; None of a sample."""
    return int(block.reading.record["kind"][0]) if block.reading.kind is ReadingKind.FRAMES else None


def _dated(block: Block, t_us: int) -> Block:
    """Return a block whose words and reading are both of `t_us`: what is recorded is what the host reads."""
    record = block.reading.record.copy()
    record["t"] = t_us
    return Block(t_us, block.words, replace(block.reading, record=record))
