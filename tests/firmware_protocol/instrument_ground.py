"""A computer that hears all that an instrument says."""

import numpy as np

from firmware_protocol.events import EdgeKind, make_edges
from firmware_protocol.packets.addresses import MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Verification
from firmware_protocol.telemetry.reading import decode_block
from tests.made_events import steady

SIZE = (346, 260)


def stream(count, every_us=10, start_us=0, seed=1):
    """Return events at a steady rate, anywhere on the array."""
    return steady(count, start_us, every_us, seed, SIZE)


class Ground:
    """Pulls messages from an instrument through a profile, decodes them, and sends telecommands."""

    def __init__(self, instrument, profile="ccsds"):
        self.instrument = instrument
        self._mine, self._theirs = Profile(profile), Profile(profile)
        self._messages, self._commands = self._mine.unwrapper(), self._theirs.command_unwrapper()
        self.events, self.edges, self.blocks, self.heard, self.outgoing = [], [], [], [], []

    def pull(self, most=1000):
        """Take up to so many messages; return how many there were."""
        for count in range(most):
            outgoing = self.instrument.next_message()
            if outgoing is None:
                return count
            self._hear(self._theirs.wrap(outgoing.message))
            self.outgoing.append(outgoing)
            self.instrument.sent(outgoing)
        return most

    def _hear(self, octets):
        for received in self._messages.push(octets):
            message = received.message
            self.heard.append(message)
            if message.kind in (MessageKind.EVENTS, MessageKind.EDGES):
                block = decode_block(message.payload, message.t_us)
                self.blocks.append(block)
                self.events.append(block.events)
                self.edges.append(block.edges)

    def tell(self, command):
        """Send a telecommand; return the verifications as they came."""
        for received in self._commands.push(self._mine.wrap_command(command)):
            self.instrument.command(received)
        before = len(self.heard)
        self.pull()
        return [Verification.parse(m.payload) for m in self.heard[before:] if m.kind is MessageKind.VERIFICATION]

    def of_kind(self, kind):
        """Return the payloads of all messages of a kind."""
        return [message.payload for message in self.heard if message.kind is kind]


def edges(*times):
    return make_edges(times, EdgeKind.RISING, seq=np.arange(len(times)))
