"""The stream of a LUCID Triton2 EVS (TRT009S-E, IMX636), without I/O: orders and events in, blocks out.

    Triton2Control --orders--> obey --> Memory --rules--> acquisition, masks, rate control, biases
    array -------------------> offer -> selection --> Outflow --> next_block --> GVSP packets

The device's time is zero at AcquisitionStart: neuromorphic_drivers begins at zero and ignores a first time that is
8.4 s or more ahead.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from heapq import heappop, heappush

from firmware_protocol.device.event_device import EventDevice
from firmware_protocol.device.fates import Fates
from firmware_protocol.events import EdgeKind, Edges, Events, empty_edges
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
from firmware_protocol.gige.gvsp import removed, test_packet
from firmware_protocol.gige.outflow import Extra, Outflow, Outgoing, Selection, before
from firmware_protocol.gige.registers import (
    ACQUISITION_START,
    ACQUISITION_STOP,
    BIASES,
    NOTIFY_WITH_DATA,
    Evs,
    GigeSettings,
    Memory,
    Register,
    Rule,
)
from firmware_protocol.gige.triton2_registers import (
    DO_NOT_FRAGMENT,
    TEST_PACKET,
    packet_size,
    triton2_areas,
    triton2_rules,
)

__all__ = ["Triton2"]

_MOST_EXTRA = 4096  # requested datagrams that wait
_MOST_SCHEDULED = 256


class Triton2(EventDevice):
    """The camera. `offer` takes events, `advance` the passing of stream time, `obey` orders.

    Attributes
    ----------
    owner
        The host that has control of it, or None.
    messages
        Its messages about edges to its host.
    """

    def __init__(self, settings: GigeSettings | None = None) -> None:
        self.settings = settings = settings or GigeSettings()
        self._selection = Selection(settings.size)
        rules = triton2_rules(settings.size) | self._selection.rules() | self._own_rules()
        self._memory = Memory(triton2_areas(settings), rules)
        self.owner: Peer | None = None
        self._now_us = 0
        self._outflow = Outflow(0, settings.block_us, settings.size[0])
        self._acquiring = False
        self._silent_until_us = self._epoch_us = 0
        self._fates = Fates()
        self._extra: deque[Extra] = deque()
        self._scheduled_us: list[int] = []
        self._starts = 0
        self.messages = Messages()

    def obey(self, order: Order) -> None:
        """Execute an order that the control channel has accepted."""
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
        return DeviceTime(self._starts, 1000 * (self._now_us - self._epoch_us))

    @property
    def now_us(self) -> int:
        """Stream time that the camera has reached."""
        return self._now_us

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

    @property
    def sensor_factors(self) -> Mapping[str, float]:
        """Effect on the pixels of the biases that hosts wrote; empty while they are the factory's."""
        return self.settings.biases.factors(self.biases)

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Biases that hosts changed without an effect here, each with the reason."""
        return self.settings.biases.without_effect(self.biases)

    @property
    def room_events(self) -> int:
        """Events that fit now."""
        return self.settings.capacity - self._outflow.queued

    @property
    def silent_until_us(self) -> int:
        """End of the silence after the start; 0 while the acquisition is stopped."""
        return self._silent_until_us if self.streaming else 0

    @property
    def epoch_us(self) -> int:
        """Stream time of AcquisitionStart."""
        return self._epoch_us

    @property
    def counters(self) -> Fates:
        """Fates of all events and edges offered so far."""
        return self._fates.waiting(self._outflow.queued, self._outflow.edges_queued)

    def offer(self, events: Events) -> None:
        """Queue events (n,) EVENT; raises ValueError if they go back in time or lie outside the array."""
        if not len(events):
            return
        self._check(events)
        self._fates.offered += len(events)
        self._now_us = int(events["t"][-1])
        if self.streaming:
            self._put(events)
        else:
            self._fates.not_running += len(events)

    def offer_edges(self, edges: Edges) -> None:
        """Apply edges (n,) EDGE to the trigger input."""
        self._fates.edges.offered += len(edges)
        if self.streaming and self._now_us >= self._silent_until_us:
            self._put_edges(edges)
        else:
            self._fates.edges.ignored += len(edges)

    def advance(self, now_us: int) -> None:
        """Set stream time to `now_us`."""
        self._now_us = max(self._now_us, now_us)
        self._pulse()

    def next_block(self, *, at_once: bool = False) -> Outgoing | None:
        """Return the next block for the stream, `at_once` even a recent one; report `sent` or `lost` for it later."""
        if not self.streaming or self._now_us < self._silent_until_us:
            return None
        outgoing = self._outflow.next(self._now_us, self._memory.get(Register.PACKET_SIZE) & 0xFFFF, at_once=at_once)
        if outgoing is not None:
            self._fates.take(outgoing)
        return outgoing

    def next_extra(self) -> Extra | None:
        """Return the next datagram that a host requested beside the blocks: a test packet, or a repeated one."""
        return self._extra.popleft() if self.waits_extra else None

    @property
    def waits_extra(self) -> bool:
        """True if `next_extra` has one."""
        return bool(self._extra) and self.destination is not None

    def sent(self, outgoing: Outgoing) -> None:
        """Count a block as delivered."""
        self._fates.leave(outgoing, "delivered")

    def lost(self, outgoing: Outgoing) -> None:
        """Count a block as lost on the link."""
        self._fates.leave(outgoing, "lost_on_link")

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
        due_us = self._now_us if time_ns is None else self._epoch_us + time_ns // 1000
        heappush(self._scheduled_us, max(self._now_us, due_us))
        self._pulse()

    def _pulse(self) -> None:
        """Apply the pulses that are due."""
        while self._scheduled_us and self._scheduled_us[0] <= self._now_us:
            pulse = empty_edges(1)
            pulse["t"], pulse["kind"] = heappop(self._scheduled_us), EdgeKind.PULSE
            self._fates.edges.added += 1
            self._put_edges(pulse)

    def _put_edges(self, edges: Edges) -> None:
        """Queue edges for the stream, and messages of them if the host enabled these."""
        self._outflow.put_edges(edges)
        notification = self._memory.get(Evs.EVENT_NOTIFICATION)
        if self.message_destination is not None and notification:
            for time_us, kind in zip(edges["t"].tolist(), edges["kind"].tolist(), strict=True):
                data = kind.to_bytes(4, "big") if notification == NOTIFY_WITH_DATA else b""
                self.messages.queue(EDGE_EVENT, 1000 * (time_us - self._epoch_us), data)

    def _check(self, events: Events) -> None:
        if int(events["t"][0]) < self._now_us or bool((events["t"][1:] < events["t"][:-1]).any()):
            raise ValueError("events go back in time")
        width, height = self.settings.size
        if int(events["x"].max()) >= width or int(events["y"].max()) >= height:
            raise ValueError(f"events outside the {width} x {height} array")

    def _put(self, events: Events) -> None:
        """Queue events of a running camera, except those that are not selected or find no room."""
        begun = events[before(events, self._silent_until_us) :]
        selected = self._selection.apply(begun, self._epoch_us)
        fitting = selected.events[: self.room_events]
        self._outflow.put(fitting)
        self._fates.not_running += len(events) - len(begun)
        self._fates.not_selected += selected.outside
        self._fates.dropped_rate += selected.beyond_rate
        self._fates.dropped_fifo += len(selected.events) - len(fitting)

    def _own_rules(self) -> dict[int, Rule]:
        """Return the rules of registers that do more than store a value."""
        return {
            ACQUISITION_START: self._on_start,
            ACQUISITION_STOP: self._on_stop,
            Register.PACKET_SIZE: self._on_packet_size,
        }

    def _on_start(self, value: int) -> int:
        if value and not self._acquiring:
            self._acquiring = True
            self._starts += 1
            self._epoch_us = self._now_us
            self._silent_until_us = self._now_us + self.settings.start_delay_us
            self._outflow = Outflow(self._epoch_us, self.settings.block_us, self.settings.size[0], self._outflow.number)
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
        self._fates.flushed += self._outflow.queued
        self._fates.edges.flushed += self._outflow.edges_queued
        self._outflow.clear()

    def _on_packet_size(self, value: int) -> int:
        remembered = packet_size(value)
        if value & TEST_PACKET and len(self._extra) < _MOST_EXTRA:
            self._extra.append(Extra(test_packet(value & 0xFFFF)))
        return remembered
