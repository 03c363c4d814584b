"""The contract of links over streams on a network, each with a client that we did not write or a decoder of its own."""

import pytest

from evstim.testing.link_contract import LinkContract
from tests.transports.network_streams.stream_readers import (
    CaerDatagrams,
    CaerReader,
    DatagramReader,
    DvReader,
    JaerDecoder,
    long_events,
    short_events,
    udp_port,
)
from transports.network_streams.kind import TcpLink, UdpLink

pytestmark = [pytest.mark.system, pytest.mark.socket]


class TestDv(LinkContract):
    """dv_processing.io.NetworkReader 2.0.4."""

    parameters = TcpLink(port=0)

    def reader(self, link):
        return DvReader(link)


class TestCaer(LinkContract):
    parameters = TcpLink(port=0, format="caer")

    def reader(self, link):
        return CaerReader(link)


@pytest.mark.long
class TestJaerUdp(LinkContract):
    form, decoder = "jaer", JaerDecoder
    many, some = 20_000, 5000

    @pytest.fixture(autouse=True)
    def _receiver(self):
        self._socket = udp_port()
        self.parameters = UdpLink(self.form, port=self._socket.getsockname()[1], mbit_s=20.0)
        yield
        self._socket.close()

    def reader(self, link):
        return DatagramReader(self._socket, self.decoder())


@pytest.mark.long
class TestCaerUdp(TestJaerUdp):
    form, decoder = "caer", CaerDatagrams


class TestFaeryLongUdp(TestJaerUdp):
    form, decoder = "t64_x16_y16_on8", staticmethod(lambda: long_events)


@pytest.mark.long
class TestFaeryShortUdp(TestJaerUdp):
    form, decoder = "t32_x16_y15_on1", staticmethod(lambda: short_events)
