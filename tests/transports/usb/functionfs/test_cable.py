"""The cable beyond the contract of USB cables: hosts that do not read, go, reset, and come again; each event's fate."""

import numpy as np
import pytest

from evstim.testing.link_contract import event_stream
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.genx320.device import Genx320, Genx320Settings
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import SetupPacket, Transfer
from firmware_protocol.usb.functionfs import EventKind
from tests.transports.usb.conftest import FakeDevice
from tests.transports.usb.gadget_port import PACKET_BYTES, PATIENCE_S, GadgetBench, PortHost
from transports.faults.faulty_device import FaultyDevice
from transports.faults.script import FaultPlan
from transports.faults.usb import UsbStall
from transports.usb.davis_host import DavisHost
from transports.usb.host import StallError, StreamSettings, TransferTimeout
from transports.usb.treuzell_host import TreuzellHost

DESCRIPTORS = Davis346Settings().descriptors()
SETTINGS = StreamSettings(transfer_bytes=8192, transfers=4, reset_timestamps=False)


@pytest.fixture
def bench():
    bench = GadgetBench()
    yield bench
    bench.close()


@pytest.fixture
def camera():
    return Davis346(Davis346Settings(start_delay_us=0, fifo_bytes=4096))


def show(camera, events):
    camera.offer(events)
    camera.advance(int(events["t"][-1]))


def started(bench, device, **keys):
    """Return a driver that has started the camera behind a new cable."""
    host = PortHost(bench.plug(device, DESCRIPTORS, **keys), PATIENCE_S)
    driver = DavisHost(host)
    driver.start(SETTINGS)
    bench.until(lambda: bench.cable.enabled)
    return host, driver


def shown(bench, camera, count, first=0):
    """Show the camera a part of the event stream, and return it."""
    events = event_stream(first + count)[first:]
    bench.call(show, camera, events)
    return events


def test_a_host_that_never_reads_holds_up_nothing(bench, camera):
    host, _ = started(bench, camera)
    for k in range(20):
        shown(bench, camera, 500, 500 * k)
    counters = camera.counters
    assert counters.dropped_fifo > 0
    assert counters.accounted == counters.offered == 10_000
    assert host.control_in(SetupPacket(0xC0, 0xBF, 6, 0, 4))[-1] == 18


def test_what_a_host_that_goes_did_not_take_is_lost(bench, camera):
    host, _ = started(bench, camera)
    shown(bench, camera, 500)
    host.close()
    bench.until(lambda: bench.cable.idle)
    counters = camera.counters
    assert counters.lost_on_link > 0
    assert counters.delivered == counters.queued == 0
    assert counters.accounted == 500


@pytest.mark.parametrize("turns", [(EventKind.DISABLE, EventKind.ENABLE), (EventKind.ENABLE,)])
def test_a_reset_is_a_new_host_which_gets_nothing_of_the_old_stream(bench, camera, turns):
    """The kernel tells of the second turn alone where nobody has read of the first."""
    host, _ = started(bench, camera)
    host.control_out(SetupPacket(0x40, 0xBF, 1, 32, 4), bytes((0, 0, 0, 99)))
    shown(bench, camera, 300)
    for turn in turns:
        bench.port.turn(turn)
    host = PortHost(bench.port, PATIENCE_S)
    assert host.control_in(SetupPacket(0xC0, 0xBF, 1, 32, 4))[-1] == 8  # as at power-on
    driver = DavisHost(host)
    driver.start(SETTINGS)
    sent = shown(bench, camera, 200, 300)
    received = driver.read(PATIENCE_S)
    assert np.array_equal(received["x"], sent["x"][: len(received)])
    assert len(received) > 0
    assert camera.counters.accounted == 500


def test_a_stream_that_the_host_ended_does_not_begin_the_next(bench, camera):
    _, driver = started(bench, camera, grace_s=0.01)
    shown(bench, camera, 300)
    bench.until(lambda: camera.counters.queued > 0)
    driver.stop = None  # it was killed: nobody reads what is on its way, and the next one finds the camera running
    host = PortHost(bench.port, PATIENCE_S)
    host.configure = lambda: None
    second = DavisHost(host)
    host.control_out(SetupPacket(0x40, 0xBF, 0, 0, 4), bytes(4))
    bench.until(lambda: camera.counters.queued == 0)
    assert camera.counters.lost_on_link > 0
    second.start(SETTINGS)
    sent = shown(bench, camera, 200, 300)
    received = second.read(PATIENCE_S)
    assert len(received) > 0
    assert np.array_equal(received["x"], sent["x"][: len(received)])


def test_a_transfer_in_time_is_not_given_up(bench, camera):
    """The host stops the camera and reads on, as drivers do."""
    host, _ = started(bench, camera, grace_s=PATIENCE_S)
    shown(bench, camera, 300)
    bench.until(lambda: camera.counters.queued > 0)
    host.control_out(SetupPacket(0x40, 0xBF, 0, 0, 4), bytes(4))
    for _ in range(10):  # turns of the loop, in which an impatient cable would give up
        bench.call(bool)
    assert len(host.bulk_in(2, 65536)) > 0
    bench.until(lambda: camera.counters.queued == 0)
    assert camera.counters.delivered > 0
    assert camera.counters.lost_on_link == 0


def test_the_end_of_a_run_waits_for_a_host_that_reads(bench, camera):
    host, _ = started(bench, camera)
    shown(bench, camera, 300)
    bench.until(lambda: camera.counters.queued > 0)
    reader = host.stream(2, 65536)
    data = reader.read(PATIENCE_S)
    bench.unplug(linger_s=PATIENCE_S)
    assert data
    assert camera.counters.delivered > 0
    assert camera.counters.accounted == 300


def test_the_end_of_a_run_does_not_wait_for_ever(bench, camera):
    started(bench, camera)
    shown(bench, camera, 300)
    bench.unplug()
    assert camera.counters.queued == camera.counters.delivered == 0
    assert camera.counters.accounted == 300


@pytest.mark.parametrize("length", [PACKET_BYTES, 2 * PACKET_BYTES, 2 * PACKET_BYTES - 2, 2])
def test_a_transfer_ends_with_a_packet_that_is_not_full(bench, length):
    device = FakeDevice()
    device.chunks.append(bytes(length))
    host = PortHost(bench.plug(device, DESCRIPTORS), PATIENCE_S)
    host.configure()
    assert host.bulk_in(2, 65536) == bytes(length)
    device.wait_for("sent")


def test_a_device_that_comes_to_harm_is_lost_alone(bench):
    """A host that gave up a request gets the answer of its next one."""
    device = FakeDevice()
    host = PortHost(bench.plug(device, DESCRIPTORS), PATIENCE_S)
    with pytest.raises(StallError):
        host.control_in(SetupPacket(0xC0, 0x77, 0, 0, 4))
    assert host.control_in(SetupPacket(0xC0, 0xBF, 0, 0, 4)) == bytes(4)


def test_a_halt_while_a_transfer_waits_comes_after_it(bench, camera):
    faulty = FaultyDevice(camera, FaultPlan("usb"))
    host, _ = started(bench, faulty)
    shown(bench, camera, 300)
    bench.call(faulty.inject, UsbStall())
    assert len(host.bulk_in(2, 65536)) > 0
    bench.until(lambda: bench.port.pipe(0x82).halted)
    with pytest.raises(StallError):
        host.bulk_in(2, 65536)
    host.clear_halt(2)
    shown(bench, camera, 100, 300)
    assert len(host.bulk_in(2, 65536)) > 0


@pytest.mark.parametrize("make", [lambda: Evk4(Evk4Settings(serial="0badcafe", start_delay_us=0)),
                                  lambda: Genx320(Genx320Settings(serial="0badcafe", start_delay_us=0))])  # fmt: skip
def test_a_board_of_prophesees_is_asked_and_answers_on_its_own_endpoints(bench, make):
    camera = make()
    port = bench.plug(camera, camera.descriptors(Speed.SUPER))
    host = PortHost(port, PATIENCE_S)
    driver = TreuzellHost(host)
    assert driver.info.serial == "0BADCAFE"
    driver.start()
    events = event_stream(1000, size=(320, 260))
    bench.call(show, camera, events)
    received = driver.read(PATIENCE_S)
    assert np.array_equal(received, events[: len(received)])
    assert len(received) > 0
    driver.close()


def test_a_refusal_of_data_halts_the_endpoint(bench):
    camera = Evk4(Evk4Settings(start_delay_us=0))
    host = PortHost(bench.plug(camera, camera.descriptors(Speed.SUPER)), PATIENCE_S)
    host.configure()
    for _ in range(66):  # one answer is on its way, 64 wait, and one is too many
        host.bulk_out(2, bytes(8))
    bench.until(lambda: bench.port.pipe(0x02).halted)
    assert len(camera._answers) == 64


def test_nothing_of_a_device_is_read_before_a_host_has_chosen_the_configuration(bench):
    device = FakeDevice()
    device.chunks.append(b"words")
    host = PortHost(bench.plug(device, DESCRIPTORS), 0.2)
    with pytest.raises(TransferTimeout):
        host.bulk_in(2, 512)
    assert device.given == []
    host._timeout_s = PATIENCE_S
    host.configure()
    assert host.bulk_in(2, 512) == b"words"
    assert Transfer(data=b"words").data == device.given[0]
