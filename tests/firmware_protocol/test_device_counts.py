"""Counts and versions that a link reads at every tick are those of the complete counters and settings."""

import pytest
from davis_host import Host as DavisRequests
from gige_host import Host as GigeHost
from instrument_ground import Ground, stream

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.device.plain_device import PlainDevice
from firmware_protocol.events import EdgeKind, make_edges
from firmware_protocol.gen31.device import Gen31, Gen31Settings
from firmware_protocol.genx320.device import Genx320, Genx320Settings
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.telecommands import SetBias
from transports.usb.loopback import DirectHost
from transports.usb.treuzell_host import TreuzellHost


def edges_at(*times_us):
    return make_edges(times_us, EdgeKind.PULSE)


def davis():
    camera = Davis346(Davis346Settings(start_delay_us=0))
    host = DavisRequests(camera)
    host.write_all(((4, 0, 1), (4, 3, 1), (0, 0, 1), (0, 1, 1), (0, 3, 1), (9, 0, 1), (1, 3, 1)))
    return camera, lambda: camera.read(2, 512)


def board(camera):
    TreuzellHost(DirectHost(camera)).start()
    return camera, lambda: camera.read(1, 512)


BOARDS = [
    lambda: board(Evk4(Evk4Settings(start_delay_us=0))),
    lambda: board(Genx320(Genx320Settings(start_delay_us=0))),
    lambda: board(Gen31(Gen31Settings(start_delay_us=0))),
]


def triton2():
    host = GigeHost()
    host.start()
    return host.camera, lambda: host.camera.next_block(at_once=True)


def instrument():
    camera = Instrument((346, 260), InstrumentSettings(housekeeping_s=0))
    return camera, camera.next_message


def plain():
    camera = PlainDevice()
    return camera, lambda: camera.take(100)


@pytest.mark.parametrize("make", [davis, *BOARDS, triton2, instrument, plain])
def test_counts_are_those_of_the_counters(make):
    camera, take = make()
    events = stream(1000)
    events["x"] %= 320
    for step in (
        lambda: camera.offer(events[:500]),
        lambda: camera.advance(5000),
        lambda: camera.sent(take()),
        lambda: camera.offer_edges(edges_at(5_100, 6_000)),
        lambda: camera.offer(events[500:]),
        lambda: camera.advance(20_000),
        take,
    ):
        step()
        assert camera.delivered == camera.counters.delivered
        assert camera.waiting_items == camera.counters.all_queued
    assert camera.delivered > 0
    assert camera.waiting_items > 0


def write_davis():
    camera = Davis346()
    return camera, lambda: DavisRequests(camera).write(5, 12, 1)


def write_evk4():
    camera = Evk4()
    host = TreuzellHost(DirectHost(camera))
    return camera, lambda: host.write_register(0x1000, 0x11A1_0504)


def write_triton2():
    host = GigeHost()
    return host.camera, host.start


def command_instrument():
    camera = Instrument((346, 260))
    return camera, lambda: Ground(camera).tell(SetBias(12, 1))


@pytest.mark.parametrize("make", [write_davis, write_evk4, write_triton2, command_instrument])
def test_a_request_that_changes_settings_changes_their_version(make):
    camera, request = make()
    before = camera.settings_version
    camera.offer(stream(10))
    camera.advance(1000)
    assert camera.settings_version == before
    request()
    assert camera.settings_version != before


@pytest.mark.parametrize("make", [davis, *BOARDS, triton2, instrument, plain])
def test_a_camera_whose_data_a_host_reads_is_not_at_rest(make):
    camera, _ = make()
    assert not camera.at_rest
