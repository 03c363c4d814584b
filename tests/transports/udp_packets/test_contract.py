"""The contract of links over packets in datagrams, read by the spacepackets library."""

import pytest
from spacepackets.ecss.tm import PusTm

from evstim.testing.link_contract import LinkContract
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.telemetry.reading import decode_block
from tests.transports.network_streams.stream_readers import DatagramReader, udp_port
from transports.udp_packets.kind import UdpPacketsLink

pytestmark = [pytest.mark.system, pytest.mark.socket]


def decoded(datagram):
    """Return the events of a datagram; its headers and checksum are read by others."""
    packet = PusTm.unpack(datagram, timestamp_len=7)
    if (packet.service, packet.message_subtype) != (128, 129):
        return []
    seconds, fraction = int.from_bytes(packet.timestamp[:4], "big"), int.from_bytes(packet.timestamp[4:], "big")
    return list(decode_block(packet.tm_data, round((seconds + fraction / 2**24) * 1e6)).events)


class TestUdpPackets(LinkContract):
    many, some = 20_000, 5000

    @pytest.fixture(autouse=True)
    def _receiver(self):
        self._socket = udp_port()
        port = self._socket.getsockname()[1]
        settings = InstrumentSettings(queue_ms=60_000.0)
        self.parameters = UdpPacketsLink(port=port, command_port=0, mbit_s=20.0, instrument=settings)
        yield
        self._socket.close()

    def reader(self, link):
        return DatagramReader(self._socket, decoded)
