"""The Triton2's time by a master of the Precision Time Protocol: registers, latched time, stamps, actions."""

import pytest

from firmware_protocol.events import EDGE, EdgeKind
from firmware_protocol.gige.control import Pulse
from firmware_protocol.gige.gvcp import Command, Flag, Status, request
from firmware_protocol.gige.registers import PTP_ON, Capability, Register
from firmware_protocol.imx636.triton2_control import PtpClock, Triton2Control, ptp_identity
from firmware_protocol.imx636.triton2_registers import Ptp, Triton2Settings, features
from firmware_protocol.ptp.slave import PortState
from tests.firmware_protocol.gige_host import PEER, Host, steady
from tests.firmware_protocol.ptp_network import SLAVE, Master, Network, S

SHIFT_NS = 1_700_000_000 * S + 123


class PtpHost(Host):
    """A host of a camera whose clock is that of a `Network`."""

    def __init__(self, network):
        super().__init__(ptp=True)
        self.network = network
        network.slave.disable()
        clock = PtpClock(network.slave, lambda: network.local_ns(network.true_ns))
        self.control = Triton2Control(self.camera.settings, lambda: self.camera.time, ptp=clock)
        assert self.write(Register.PRIVILEGE, 2) == 0

    def read_64(self, address):
        value = self.read(address) << 32 | self.read(address + 4)
        return value - (value >> 63 << 64)

    def send_only(self, command, payload, flags):
        """Send a request without its orders being obeyed; returns the status."""
        ((data, _),) = self.control.receive([(request(command, 7, payload, flags), PEER)], self.now_ns)
        return int.from_bytes(data[:2], "big")

    def latched_ns(self):
        assert self.write(Register.TIME_CONTROL, 2) == 0
        return self.read_64(Register.TIME_HIGH)


@pytest.fixture
def master():
    return Master()


@pytest.fixture
def host(master):
    return PtpHost(Network(master))


def test_a_camera_without_it_is_as_it_was():
    plain = Host()
    assert not plain.read(Register.CAPABILITY) & Capability.PTP
    plain.start()
    assert plain.write(Register.GVCP_CONFIGURATION, PTP_ON) == 0
    assert plain.read(Register.PTP_STATE) == 0
    assert plain.send(Command.READREG, int(Ptp.STATE).to_bytes(4, "big"))[0] == Status.INVALID_ADDRESS
    assert plain.write(Ptp.LATCH, 1) == Status.INVALID_ADDRESS
    assert not [one for one in features((1280, 720)) if one.name.startswith("Ptp")]


def test_a_host_switches_it_on_and_latches_its_data_sets(host, master):
    assert host.read(Register.CAPABILITY) & Capability.PTP
    assert (host.read(Ptp.STATE), host.read_64(Ptp.CLOCK)) == (PortState.DISABLED, SLAVE)
    assert host.write(Register.GVCP_CONFIGURATION, PTP_ON) == 0
    host.network.run(20)
    assert host.read(Ptp.STATE) == PortState.DISABLED  # as latched
    assert host.read(Register.PTP_STATE) == PortState.SLAVE
    host.network.slave._offset_ns = -5
    assert host.write(Ptp.LATCH, 1) == 0
    assert (host.read(Ptp.STATE), host.read(Ptp.SERVO) & 1) == (PortState.SLAVE, 1)
    assert host.read_64(Ptp.OFFSET) == -5
    assert host.read_64(Ptp.DELAY) == pytest.approx(host.network.delay_ns, abs=10)
    identity = master.identity - (master.identity >> 63 << 64)
    assert (host.read_64(Ptp.PARENT), host.read_64(Ptp.GRANDMASTER)) == (identity, identity)
    assert host.write(Register.GVCP_CONFIGURATION, 0) == 0
    assert host.network.slave.state == PortState.DISABLED


def test_the_latched_time_is_the_masters_as_soon_as_there_is_one(host, master):
    assert host.latched_ns() == 0
    host.write(Register.GVCP_CONFIGURATION, PTP_ON)
    host.network.run(20)
    assert host.latched_ns() == pytest.approx(host.network.true_ns + master.ahead_ns, abs=100)
    host.write(Register.GVCP_CONFIGURATION, 0)
    assert host.latched_ns() == 0


def test_writing_another_bit_does_not_begin_anew(host):
    host.write(Register.GVCP_CONFIGURATION, PTP_ON)
    host.network.run(20)
    host.write(Register.GVCP_CONFIGURATION, PTP_ON | 1)
    assert host.network.slave.state == PortState.SLAVE
    host.network.slave.fail()
    host.write(Register.GVCP_CONFIGURATION, PTP_ON)
    assert host.network.slave.state == PortState.FAULTY  # its sockets clear that


def test_the_identity_follows_from_the_mac():
    assert ptp_identity(Triton2Settings(serial="1")) >> 24 == 0x1C0FAFFFFE
    assert ptp_identity(Triton2Settings(serial="1")) != ptp_identity(Triton2Settings(serial="2"))


def _stream(shift_ns):
    host = Host()
    host.camera.advance(1000)
    host.start()
    host.camera.follow(shift_ns)
    host.camera.offer(steady(100, start_us=5000))
    host.camera.advance(10_000)
    return [outgoing.block for outgoing in host.blocks()]


def test_a_block_has_the_masters_time_and_the_same_events():
    (plain,), (followed,) = _stream(None), _stream(SHIFT_NS)
    assert followed.data == plain.data
    assert plain.time_ns == 4_000_000  # since the start of the acquisition
    assert followed.time_ns == 5_000_000 + SHIFT_NS


@pytest.mark.parametrize(("shift_ns", "time_ns"), [(-(1 << 62), 0), (1 << 65, (1 << 64) - 1)])
def test_a_time_that_no_leader_can_have_is_limited(shift_ns, time_ns):
    (block,) = _stream(shift_ns)
    assert int.from_bytes(block.packet(0)[24:32], "big") == time_ns


def test_the_next_acquisition_has_the_masters_time_too():
    host = Host()
    host.camera.follow(SHIFT_NS)
    host.start()
    host.camera.advance(5000)
    host.camera.offer(steady(1, start_us=5000))
    assert [outgoing.block.time_ns for outgoing in host.blocks()] == []
    host.camera.advance(7000)
    assert [outgoing.block.time_ns for outgoing in host.blocks()] == [5_000_000 + SHIFT_NS]


def test_an_action_is_scheduled_in_the_masters_time(host, master):
    host.write(Register.GVCP_CONFIGURATION, PTP_ON)
    host.network.run(20)
    now_ns = host.network.true_ns + master.ahead_ns
    keys = bytes(8) + (1).to_bytes(4, "big")
    for address, value in ((Register.ACTION_DEVICE_KEY, 0), (Register.ACTION_GROUP + 4, 1)):
        assert host.write(address, value) == 0
    host.control.orders.clear()
    for ahead_ns, status, pulse in ((S, Status.SUCCESS, now_ns + S), (-S, Status.ACTION_LATE, None)):
        payload = keys + (now_ns + ahead_ns).to_bytes(8, "big")
        assert host.send_only(Command.ACTION, payload, flags=1 | Flag.SCHEDULED) == status
        assert host.control.orders.popleft() == Pulse(pulse)


def test_a_pulse_in_the_masters_time_comes_at_that_time_of_the_stream():
    host = Host()
    host.start()
    host.camera.follow(SHIFT_NS)
    host.camera.obey(Pulse(9_000_000 + SHIFT_NS))
    host.camera.advance(8000)
    assert not [edge for outgoing in host.blocks() for edge in outgoing.edges]
    host.camera.advance(20_000)
    edges = [edge for outgoing in host.blocks() for edge in outgoing.edges]
    changes = [(int(edge["t"]), int(edge["kind"])) for edge in edges]
    assert changes == [(9000, EdgeKind.RISING), (9100, EdgeKind.FALLING)]
    assert edges[0].dtype == EDGE
