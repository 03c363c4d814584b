"""The place of faults on a serial line: between the endpoint's one way out and its port.

    endpoint._write --> stage --> stage --> [what the port had no room for] --> port
                                   |
                                   +--> witness: which messages a sound receiver gets

While no fault is at work bytes pass untouched and unseen. A byte that went into a stage has left, as far as the camera
can know; what the port then has no room for waits here, and the next ones are refused, as by a full port.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from firmware_protocol.instrument.outgoing import Outgoing
from firmware_protocol.packets.profile import Profile, Unwrapper
from transports.faults.kinds import Fault
from transports.faults.line import ByteStage, byte_stage
from transports.faults.reference_receiver import ReferenceReceiver
from transports.faults.script import FaultPlan, FaultRecord, Faults

__all__ = ["FaultyLine"]

_Write = Callable[[bytes], int]


class FaultyLine:
    """A line on which faults happen.

    Parameters
    ----------
    profile
        Packets and framing of what is sent.
    bytes_per_s
        The line's capacity.
    arrived
        Is told of each message that a sound receiver gets.
    """

    def __init__(self, plan: FaultPlan, profile: str, bytes_per_s: float, arrived: Callable[[Outgoing], None]) -> None:
        self._faults: Faults[ByteStage] = Faults(plan, partial(byte_stage, bytes_per_s=bytes_per_s))
        self._profile = profile
        self._arrived = arrived
        self._reference: ReferenceReceiver | None = None
        self._unwrapper: Unwrapper | None = None
        self._rest = b""
        self._sent = 0
        self.false = 0

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """What each fault has done."""
        return self._faults.records

    @property
    def lost(self) -> tuple[int, int]:
        """Events and edges that faults destroyed."""
        return self._faults.lost

    @property
    def gone(self) -> bool:
        """True while a fault has taken the port away."""
        return any(stage.gone for stage in self._faults.stages)

    def advance(self, now_us: int, begun: bytes) -> None:
        """Let stream time pass; `begun` is what has left of the frame on the line."""
        for stage in self._faults.advance(now_us):
            self._arrive(stage.finish())
            if self._reference is not None:
                self._reference.damaged()
        self._watch(begun)

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for one that a line does not have."""
        self._faults.inject(fault)

    def write(self, data: bytes, port: _Write) -> int:
        """Send bytes by way of the faults; return how many of them have left."""
        if not self.flush(port) or any(stage.holds for stage in self._hold(data)):
            return 0
        if self._faults.stages:
            taken = len(data)
            self._arrive(self._changed(data))
            self.flush(port)
        else:
            taken = port(data)
            self._see(data[:taken])
        self._sent += taken
        return taken

    def flush(self, port: _Write) -> bool:
        """Give the port what waits here; say whether it took all of it."""
        if self._rest:
            self._rest = self._rest[port(self._rest) :]
        return not self._rest

    def left(self, outgoing: Outgoing) -> None:
        """The last byte of this has left."""
        if self._reference is None:
            self._arrived(outgoing)
        else:
            self._reference.left(outgoing)

    def settle(self) -> None:
        """Find out what came of what has left."""
        if self._reference is None:
            return
        came, lost = self._reference.settle()
        self._lose(lost)
        for outgoing in came:
            self._arrived(outgoing)
        self.false += self._reference.false
        self._reference.false = 0
        if self._reference.in_step and not self._faults.stages:
            self._reference = None

    def drop(self) -> None:
        """The line has gone, or its receiver: nothing more comes of what is under way."""
        self._rest = b""
        if self._reference is not None:
            self.settle()
        if self._reference is not None:
            self._lose(self._reference.give_up())
            self._reference = None

    def close(self) -> None:
        """End all faults."""
        self.drop()
        self._faults.close()

    def _watch(self, begun: bytes) -> None:
        if self._faults.stages and self._reference is None:
            self._reference, self._unwrapper = ReferenceReceiver(), Profile(self._profile).unwrapper()
            self._see(begun)

    def _hold(self, data: bytes) -> list[ByteStage]:
        holding = [stage for stage in self._faults.stages if stage.holds]
        for stage in holding:
            before = stage.hits
            stage.change(data)
            if stage.hits != before:
                self._faults.struck(stage, [self._sent])
        return holding

    def _changed(self, data: bytes) -> bytes:
        for stage in self._faults.stages:
            before = stage.touched
            data = stage.change(data)
            if stage.touched != before or stage.places:
                self._faults.struck(stage, [self._sent + place for place in stage.places])
        return data

    def _arrive(self, data: bytes) -> None:
        self._rest += data
        self._see(data)

    def _see(self, data: bytes) -> None:
        if self._reference is not None and self._unwrapper is not None:
            self._reference.came(self._unwrapper.push(data))

    def _lose(self, lost: list[Outgoing]) -> None:
        for outgoing in lost:
            self._faults.lose(len(outgoing.events), len(outgoing.edges))
