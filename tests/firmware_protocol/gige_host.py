"""A host for tests: requests into a camera without sockets, answers out, and the stream put together."""

import struct

from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.gige.gvcp import Command, request
from firmware_protocol.gige.gvsp import BlockAssembly
from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2 import Triton2
from firmware_protocol.imx636.triton2_control import Triton2Control
from firmware_protocol.imx636.triton2_registers import ACQUISITION_START, Triton2Settings
from tests import made_events

PEER = ("127.0.0.1", 40_000)
STRANGER = ("127.0.0.1", 40_001)


def steady(n, start_us=0, step_us=1, seed=0, size=(1280, 720)):
    """`n` events, one each `step_us`, at random pixels."""
    return made_events.steady(n, start_us, step_us, seed, size)


class Host:
    """Talks to a camera as drivers do."""

    def __init__(self, **settings):
        chosen = Triton2Settings(**{"start_delay_us": 0, **settings})
        self.camera = Triton2(chosen)
        self.control = Triton2Control(chosen, lambda: self.camera.time)
        self.number = 0
        self.now_ns = 0
        self.assembly = BlockAssembly()
        self.decoder = Evt3Decoder()

    def receive(self, datagrams):
        """Bring datagrams to the camera; returns the answers."""
        answers = self.control.receive(datagrams, self.now_ns)
        while self.control.orders:
            self.camera.obey(self.control.orders.popleft())
        return answers

    def send(self, command, payload=b"", peer=PEER, flags=1):
        """Send a request; returns (status, payload) of the answer, or None."""
        self.number = self.number % 0xFFFF + 1
        answers = self.receive([(request(command, self.number, payload, flags), peer)])
        if not answers:
            return None
        (data, to) = answers[0]
        status, command_back, length, number = struct.unpack_from(">HHHH", data)
        assert (to, number, length) == (peer, self.number, len(data) - 8)
        assert command_back == command + 1
        return status, data[8:]

    def write(self, address, value, peer=PEER):
        """Write a register; returns the status."""
        return self.send(Command.WRITEREG, struct.pack(">II", address, value & 0xFFFFFFFF), peer)[0]

    def read(self, address, peer=PEER):
        """Read a register."""
        status, data = self.send(Command.READREG, struct.pack(">I", address), peer)
        assert status == 0, hex(status)
        return int.from_bytes(data, "big")

    def start(self, packet_size=1400):
        """Take control and start the stream."""
        for address, value in (
            (Register.PRIVILEGE, 2), (Register.PACKET_SIZE, packet_size), (Register.STREAM_ADDRESS, 0x7F000001),
            (Register.STREAM_PORT, 50_000), (ACQUISITION_START, 1),
        ):  # fmt: skip
            assert self.write(address, value) == 0, hex(address)

    def blocks(self):
        """Take what the camera has ready; all of it counts as sent."""
        while (outgoing := self.camera.next_block()) is not None:
            self.camera.sent(outgoing)
            yield outgoing

    def collect(self):
        """Take what the camera has ready and decode it."""
        data = []
        for outgoing in self.blocks():
            for number in range(outgoing.block.packets):
                data += self.assembly.push(outgoing.block.packet(number), 0)
        return self.decoder.decode(b"".join(data))
