"""The stream of a LUCID Triton2 EVS (TRT009S-E, IMX636), without I/O: orders and events in, blocks out.

    Triton2Control --orders--> obey --> Memory --rules--> acquisition, masks, rate control, biases
    array -------------------> offer -> selection --> BlockOutflow --> next_block --> GVSP packets

The device's time is zero at AcquisitionStart: neuromorphic_drivers begins at zero and ignores a first time that is
8.4 s or more ahead.

A block of the real camera has reserved EVT3 words, which carry no event:

    time high | 0xE0FF, "other" of subtype 0x0FF | ... | 0x9999, padding

Sources: of 0xE0FF, a published capture of a TRT009S-E (octets 8E 8A FF E0), in the tests of viva-genicam; of 0x9999,
LUCID's reply in event_camera_renderer, issue 8. The amount of padding is not public: here up to a multiple of
8 octets, as a block of the capture has (824).

`RangeSelection` holds the ranges of rows and columns and the rate control that a host writes, and applies them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from heapq import heappop, heappush

import numpy as np

from firmware_protocol.device.items import Items
from firmware_protocol.events import EdgeKind, Edges, Events, Mask, make_edges
from firmware_protocol.evt.evt3 import Evt3Encoder
from firmware_protocol.gige.control import (
    EDGE_EVENT,
    DeviceTime,
    Messages,
    MessageSettings,
    Order,
    Owner,
    Peer,
    Pulse,
    Write,
)
from firmware_protocol.gige.gvcp import Resend, Status
from firmware_protocol.gige.gvsp import BLOCK_OCTETS, Block, removed, test_packet
from firmware_protocol.gige.registers import DO_NOT_FRAGMENT, TEST_PACKET, Memory, Register, Rule, packet_size
from firmware_protocol.imx636.triton2_registers import (
    ACQUISITION_START,
    ACQUISITION_STOP,
    BIASES,
    COLUMNS,
    INVERTED,
    MOST_RANGES,
    NOTIFY_WITH_DATA,
    PERIOD_US,
    ROWS,
    Erc,
    Evs,
    RangeRegisters,
    Triton2Settings,
    evs_rules,
    triton2_areas,
    triton2_rules,
)
from firmware_protocol.prophesee.camera import (
    LONGEST_GAP_US,
    Outflow,
    OutflowLimits,
    PropheseeCamera,
    RateControl,
    Selected,
)

_MOST_EXTRA = 4096  # requested datagrams that wait
_MOST_SCHEDULED = 256
_SENT_BLOCKS = 256
_MOST_EVENTS = BLOCK_OCTETS // 4  # a row and a column each; events that need more octets go into the next block
_OTHER = b"\xff\xe0"
_PADDING = b"\x99\x99"
_PADDED_OCTETS = 8
_MOST_EDGES = 1 << 16
_SILENCE_US = 1_000_000
_LAST_NS = (1 << 64) - 1


@dataclass(frozen=True)
class Outgoing(Items):
    """A block, and the items in it."""

    block: Block = field(kw_only=True)


@dataclass(frozen=True)
class Extra:
    """A datagram of the stream that a host requested, with its block and packet number; block 0: none."""

    data: bytes
    block: int = 0
    number: int = 0


class BlockOutflow(Outflow[Outgoing]):
    """Outflow to numbered blocks, each with its time and row, so that the loss of one does not affect others.

    Sent blocks are stored for a while, so that they can be sent again. During a silence, blocks without events carry
    the time.

    Attributes
    ----------
    number : number of the last block.
    shift_ns : time of a master clock less the camera's, ns; None: times count from the start of the acquisition.
    """

    def __init__(self, epoch_us: int, settings: Triton2Settings, number: int = 0) -> None:
        encoder = Evt3Encoder(standalone=True, width=settings.size[0], origin_us=epoch_us)
        super().__init__(encoder, epoch_us, OutflowLimits(settings.capacity, _MOST_EDGES, _SILENCE_US))
        self._block_us = settings.block_us
        self._has_reserved = settings.reserved_words
        self._sent_blocks: deque[Block] = deque(maxlen=_SENT_BLOCKS)
        self.number = number
        self.shift_ns: int | None = None

    def take(self, now_us: int, room: int, *, at_once: bool = False) -> Outgoing | None:
        """Return the next block, in packets of `room` octets; None while it is empty, or may grow and not `at_once`."""
        first_us = self._due_us(now_us)
        if first_us is not None:
            grows = not at_once and self._queued < _MOST_EVENTS and now_us - first_us < self._block_us
            return None if grows else self._block(first_us, now_us, room)
        words = self._silence_words(now_us)
        if not words:
            return None
        return Outgoing(epoch_us=self.epoch_us, block=self._numbered(words, self._reported_us, room))

    def stamp_ns(self, time_us: int) -> int:
        """Return the time that a host gets for a time of the camera's clock."""
        if self.shift_ns is None:
            return 1000 * (time_us - self.epoch_us)
        return min(_LAST_NS, max(0, 1000 * time_us + self.shift_ns))

    def camera_us(self, stamp_ns: int) -> int:
        """Return the time of the camera's clock for one that a host gave."""
        return self.epoch_us + stamp_ns // 1000 if self.shift_ns is None else (stamp_ns - self.shift_ns) // 1000

    def sent_block(self, number: int) -> Block | None:
        """Return a block that was sent; None if it is no longer stored, or never was."""
        return next((block for block in self._sent_blocks if block.number == number), None)

    def _block(self, first_us: int, now_us: int, packet_size: int) -> Outgoing:
        """Return a block of as many items as fit, at most a second of them: no time words are needed in between."""
        events = self._taken(first_us + LONGEST_GAP_US, _MOST_EVENTS)
        full = len(events) == _MOST_EVENTS
        edges = self._due_edges(int(events["t"][-1]) if full else min(now_us, first_us + LONGEST_GAP_US))
        words, used, used_edges = next(self._encoder.parts(events, edges, BLOCK_OCTETS - _PADDED_OCTETS))
        self._put_back(events[used:])
        events, edges = events[:used], edges[:used_edges]
        self._reach(events, edges)
        return Outgoing(events, edges, self.epoch_us, block=self._numbered(words, first_us, packet_size))

    def _numbered(self, words: bytes, time_us: int, packet_size: int) -> Block:
        self.number += 1
        if self._has_reserved:
            words = with_reserved_words(words)
        block = Block(self.number, self.stamp_ns(time_us), words, packet_size)
        self._sent_blocks.append(block)
        return block


def with_reserved_words(words: bytes) -> bytes:
    """Return the words of a block, the first of them a time high, with the reserved words of the real camera."""
    padding = -(len(words) + len(_OTHER)) % _PADDED_OCTETS // len(_PADDING)
    return words[:2] + _OTHER + words[2:] + _PADDING * padding


class Triton2(PropheseeCamera[BlockOutflow]):
    """The camera. `offer` takes events, `advance` the passing of stream time, `obey` orders.

    `owner`: the host that has control of it, or None; `messages`: its messages about edges to its host.
    """

    def __init__(self, settings: Triton2Settings | None = None) -> None:
        self.settings = settings = settings or Triton2Settings()
        super().__init__(settings.size, settings.biases, BlockOutflow(0, settings), settings.pulse_us)
        self._selection = RangeSelection(settings.size)
        rules = triton2_rules(settings) | self._selection.rules()
        rules |= {
            ACQUISITION_START: self._on_start,
            ACQUISITION_STOP: self._on_stop,
            Register.PACKET_SIZE: self._on_packet_size,
        }
        self._memory = Memory(triton2_areas(settings), rules)
        self.owner: Peer | None = None
        self._acquiring = False
        self._extra: deque[Extra] = deque()
        self._scheduled_us: list[int] = []
        self._starts = 0
        self.messages = Messages()

    def obey(self, order: Order) -> None:
        """Execute an order that the control channel has accepted."""
        self.settings_version += 1
        match order:
            case Write(address, value):
                self._memory.write(address, value)
            case Resend():
                self._resend(order)
            case Pulse(time_ns):
                self._schedule(time_ns)
            case Owner(peer):
                self.owner = peer
                if peer is None:
                    for register in (Register.STREAM_PORT, Register.MESSAGE_PORT, Evs.EVENT_NOTIFICATION):
                        self._memory.set(register, 0)
                    self._stop()

    @property
    def time(self) -> DeviceTime:
        """The device's clock."""
        return DeviceTime(self._starts, 1000 * (self._now_us - self.epoch_us))

    @property
    def streaming(self) -> bool:
        """True while events offered now would go to a host."""
        return self._acquiring and self.destination is not None

    @property
    def destination(self) -> tuple[int, int] | None:
        """(address as a number, port) that the host set for the stream; None while the channel is closed."""
        port = self._memory.get(Register.STREAM_PORT) & 0xFFFF
        return (self._memory.get(Register.STREAM_ADDRESS), port) if port else None

    @property
    def message_destination(self) -> tuple[int, int] | None:
        """(address as a number, port) that the host set for messages; None while the channel is closed."""
        port = self._memory.get(Register.MESSAGE_PORT) & 0xFFFF
        return (self._memory.get(Register.MESSAGE_ADDRESS), port) if port else None

    @property
    def message_settings(self) -> MessageSettings:
        """The host's timeout for its answer to a message, and its number of repetitions."""
        timeout_ms = self._memory.get(Register.MESSAGE_TIMEOUT)
        return MessageSettings(timeout_ms * 1_000_000, self._memory.get(Register.MESSAGE_RETRIES))

    @property
    def packet_delay_ns(self) -> int:
        """Pause between packets that the host set."""
        return self._memory.get(Register.PACKET_DELAY)

    @property
    def may_fragment(self) -> bool:
        """True if packets may be fragmented."""
        return not self._memory.get(Register.PACKET_SIZE) & DO_NOT_FRAGMENT

    @property
    def biases(self) -> dict[str, int]:
        """Offsets of the biases from the factory's values, by Prophesee's names."""
        values = {name: self._memory.get(bias.address) for name, bias in BIASES.items()}
        return {name: value - (value >> 31 << 32) for name, value in values.items()}

    def advance(self, now_us: int) -> None:
        """Set stream time to `now_us`, and apply the pulses that are due."""
        super().advance(now_us)
        self._pulse()

    def follow(self, shift_ns: int | None) -> None:
        """Stamp blocks and messages with a master's time, `shift_ns` ahead of the camera's clock without epoch.

        None: with the time since the start of the acquisition. The words of the events have that time in any case.
        """
        self._outflow.shift_ns = shift_ns

    def next_block(self, *, at_once: bool = False) -> Outgoing | None:
        """Return the next block for the stream, `at_once` even a recent one; report `sent` or `lost` for it later."""
        if not self.streaming or self._now_us < self._silence_end_us:
            return None
        size = self._memory.get(Register.PACKET_SIZE) & 0xFFFF
        return self._taken(self._outflow.take(self._now_us, size, at_once=at_once))

    def next_extra(self) -> Extra | None:
        """Return the next datagram that a host requested beside the blocks: a test packet, or a repeated one."""
        return self._extra.popleft() if self.waits_extra else None

    @property
    def waits_extra(self) -> bool:
        """True if `next_extra` has one."""
        return bool(self._extra) and self.destination is not None

    def disconnected(self) -> None:
        """Note that the link is closed: no host has control any more."""
        self.obey(Owner(None))

    def _resend(self, request: Resend) -> None:
        """Send packets of a block again; requests beyond the room of the queue are ignored."""
        block, room = self._outflow.sent_block(request.block), _MOST_EXTRA - len(self._extra)
        if block is None:
            self._extra.extend([Extra(removed(request.block, request.first))] * min(1, room))
            return
        for number in range(request.first, min(request.last + 1, block.packets, request.first + room)):
            data = block.packet(number, Status.PACKET_RESENT)
            self._extra.append(Extra(data, request.block, number))

    def _schedule(self, time_ns: int | None) -> None:
        """Schedule a pulse on the trigger input, now or later; ignored while the camera does not stream."""
        if not self.streaming:
            return
        if len(self._scheduled_us) == _MOST_SCHEDULED:
            self._fates.edges.added += 1
            self._fates.edges.dropped_fifo += 1
            return
        due_us = self._now_us if time_ns is None else self._outflow.camera_us(time_ns)
        heappush(self._scheduled_us, max(self._now_us, due_us))
        self._pulse()

    def _pulse(self) -> None:
        """Apply the pulses that are due."""
        while self._scheduled_us and self._scheduled_us[0] <= self._now_us:
            pulse = make_edges(heappop(self._scheduled_us), EdgeKind.PULSE)
            self._fates.edges.added += 1
            self._put_edges(pulse)

    def _put_edges(self, edges: Edges) -> None:
        """Queue edges for the stream, and messages of them if the host enabled these."""
        super()._put_edges(edges)
        notification = self._memory.get(Evs.EVENT_NOTIFICATION)
        if self.message_destination is not None and notification:
            for time_us, kind in zip(edges["t"].tolist(), edges["kind"].tolist(), strict=True):
                data = kind.to_bytes(4, "big") if notification == NOTIFY_WITH_DATA else b""
                self.messages.queue(EDGE_EVENT, self._outflow.stamp_ns(max(time_us, self.epoch_us)), data)

    @property
    def _running(self) -> bool:
        return self.streaming

    @property
    def _bias_steps(self) -> Mapping[str, int]:
        return self.biases

    def _select(self, events: Events) -> Selected:
        return self._selection.apply(events, self.epoch_us)

    def _on_start(self, value: int) -> int:
        if value and not self._acquiring:
            self._acquiring = True
            self._starts += 1
            self.epoch_us = self._now_us
            self._silence_end_us = self._now_us + self.settings.start_delay_us
            before = self._outflow
            self._outflow = BlockOutflow(self.epoch_us, self.settings, before.number)
            self._outflow.shift_ns = before.shift_ns
        return 0

    def _on_stop(self, value: int) -> int:
        if value:
            self._stop()
        return 0

    def _stop(self) -> None:
        """End the acquisition and drop the queue. Sent blocks stay available to hosts that request them again."""
        self._acquiring = False
        self._scheduled_us.clear()
        self.messages.clear()
        self._flush(self._outflow)

    def _on_packet_size(self, value: int) -> int:
        remembered = packet_size(value)
        if value & TEST_PACKET and len(self._extra) < _MOST_EXTRA:
            self._extra.append(Extra(test_packet(value & 0xFFFF)))
        return remembered


class RangeSelection:
    """Registers of ranges and of the rate control, applied to events."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._bounds = evs_rules(size)
        self._rows, self._columns = _Ranges(size[1]), _Ranges(size[0])
        self._inverted = False
        self._rate = RateControl(PERIOD_US)

    def rules(self) -> dict[int, Rule]:
        """Return the rules for writes to these registers, by address."""
        doing: dict[int, Callable[[int], None]] = {
            INVERTED: partial(setattr, self, "_inverted"),
            Erc.ON: partial(setattr, self._rate, "on"),
            Erc.PERIOD_US: partial(setattr, self._rate, "period_us"),
            Erc.EVENTS: partial(setattr, self._rate, "most"),
        }
        for registers, ranges in ((ROWS, self._rows), (COLUMNS, self._columns)):
            doing |= {getattr(registers, name): partial(ranges.write, name) for name in ranges.REGISTERS}
        return {address: _followed(self._bounds[address], do) for address, do in doing.items()}

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return the part that passes of events (n,) EVENT, sorted; the camera's clock was zero at `epoch_us`."""
        selected = events
        if self._rows.on or self._columns.on:
            crossing = self._rows.mask[events["y"]] & self._columns.mask[events["x"]]
            selected = events[~crossing if self._inverted else crossing]
        return self._rate.selected(events, selected, epoch_us)


class _Ranges:
    """Ranges of rows, or of columns, that a host writes one by one: selector, then size and offset.

    `mask`: the rows or columns in a range, (pixels,) bool; true for all while the ranges are off.
    """

    REGISTERS = tuple(field.name for field in fields(RangeRegisters))

    def __init__(self, pixels: int) -> None:
        self._sizes = np.zeros(MOST_RANGES, np.int64)
        self._offsets = np.zeros(MOST_RANGES, np.int64)
        self._selected = self._used = 0
        self.on = False
        self.mask: Mask = np.ones(pixels, np.bool_)

    def write(self, name: str, value: int) -> None:
        """Follow a write to a register, by its name in RangeRegisters; `count` is that of the ranges in use."""
        match name:
            case "on":
                self.on = bool(value)
            case "selector":
                self._selected = value
            case "size":
                self._sizes[self._selected] = value
            case "offset":
                self._offsets[self._selected] = value
            case "count":
                self._used = value
        self.mask[:] = not self.on
        for size, offset in zip(self._sizes[: self._used], self._offsets[: self._used], strict=True):
            self.mask[offset : offset + size] = True


def _followed(bounds: Rule, do: Callable[[int], None]) -> Rule:
    """Return a rule that calls `do` with a value that is within bounds."""

    def rule(value: int) -> int:
        done = bounds(value)
        do(done)
        return done

    return rule
