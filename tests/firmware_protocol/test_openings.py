"""Every camera opened twice, register by register as drivers do: no setting between two writes acts on the sensor."""

import itertools

import pytest
from davis_host import RUN, SENSORS, STOP, Host
from gen31_host import INIT as GEN31_INIT
from genx320_host import OPEN as GENX320_OPEN
from gige_host import Host as GigeHost

from firmware_protocol.davis346.biases import BIASES, DAVIS240_BIASES, CoarseFine
from firmware_protocol.davis346.device import Davis240c, Davis346
from firmware_protocol.dvxplorer.device import Dvxplorer
from firmware_protocol.dvxplorer.micro import DvxplorerMicro
from firmware_protocol.gen31.device import Gen31
from firmware_protocol.genx320.device import Genx320
from firmware_protocol.imx636.evk4 import Evk4
from firmware_protocol.imx636.triton2_registers import ACQUISITION_STOP
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.packets.ccsds import Acknowledge
from firmware_protocol.packets.profile import ReceivedCommand
from firmware_protocol.packets.telecommands import RequestId, SetBias
from transports.link.report import CameraSettings, ChangeWatch
from transports.usb.cameras import driver_of
from transports.usb.loopback import DirectHost

WRITE_NS = 100_000  # from a driver's write to the next one


def biases_of(biases, names):
    """Return writes of other currents to the biases with these names."""
    return [(5, bias.address, int(CoarseFine(3, 77))) for bias in biases if bias.name in names]


ACTING = ("DiffBn", "OnBn", "OffBn", "PrBp", "PrSFBp", "RefrBp")
LIBCAER = [*STOP, *((5, bias.address, int(bias.default)) for bias in BIASES), *RUN, *SENSORS]
DV_LEVELS = [(5, 0x1C, 0), (5, 0x0B, 0x04), (5, 0x1E, 8), (5, 0x12, 0x7F), (5, 0x0B, 0x06), (5, 0x12, 0x7D)]
ND_LEVELS = [(5, 0x0B, 0), (5, 0x12, 0x6F), (5, 0x18, 8), (5, 0x1C, 8), (5, 0x1E, 8)]
RATES = [(5, 0x325C, 1), (5, 0x3240, 9), (5, 0x3242, 1), (5, 0x3262, 5), (5, 0x3240, 0), (5, 0x325C, 0)]
IMX636_BIASES = [(0x1010, 0x60), (0x1018, 0x90), (0x1004, 0x40), (0x1020, 0x10), (0x1018, 0x59)]
GENX320_BIASES = [(0x1104, 5), (0x1128, 9), (0x110C, 90), (0x1104, 30)]
OFFSETS = [(0x13F3_0000, 40), (0x13F3_0014, -20), (0x13F3_003C, 30), (0x13F3_0000, 20)]


def on_usb(camera):
    """Return how a driver opens a camera on USB, how it writes a register, and how it closes it."""
    driver = driver_of(DirectHost(camera))
    return camera, driver.start, driver.write_register, driver.stop


def on_gige():
    host = GigeHost()
    return host.camera, host.start, host.write, lambda: host.write(ACQUISITION_STOP, 1)


def on_a_line():
    instrument = Instrument((24, 16))

    def write(bias, value):
        instrument.command(ReceivedCommand(RequestId(0, 0), Acknowledge(0), SetBias(bias, value)))

    return instrument, lambda: None, write, lambda: None


CAMERAS = {
    "davis346": (lambda: on_usb(Davis346()), [*LIBCAER, *biases_of(BIASES, ACTING)]),
    "davis240c": (lambda: on_usb(Davis240c()), biases_of(DAVIS240_BIASES, ACTING)),
    "dvxplorer by dv-processing": (lambda: on_usb(Dvxplorer()), [*RATES, *DV_LEVELS, (5, 0x1C, 3)]),
    "dvxplorer by neuromorphic_drivers": (lambda: on_usb(Dvxplorer()), [*DV_LEVELS, *ND_LEVELS]),
    "dvxplorer micro": (lambda: on_usb(DvxplorerMicro()), [(1, 14, 0), (1, 15, 0), (1, 13, 0), (1, 14, 12)]),
    "evk4": (lambda: on_usb(Evk4()), IMX636_BIASES),
    "gen31": (lambda: on_usb(Gen31()), [*GEN31_INIT, (0x034C, 0x7900_571E), (0x0350, 0x7912_5C95)]),
    "genx320": (lambda: on_usb(Genx320()), [*GENX320_OPEN, *GENX320_BIASES]),
    "triton2": (on_gige, OFFSETS),
    "instrument": (on_a_line, [(bias, value) for _, bias, value in biases_of(BIASES, ACTING)]),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_the_last_settings_of_an_opening_act_and_no_others(name, monkeypatch):
    make, writes = CAMERAS[name]
    camera, start, write, stop = make()
    watch, clock_ns = ChangeWatch(camera), itertools.count(step=WRITE_NS)

    def looked_at(function):
        def call(*arguments):
            result = function(*arguments)
            watch.look(camera.now_us, next(clock_ns))
            return result

        return call

    for requests in ("control", "write", "obey", "command"):
        if hasattr(camera, requests):
            monkeypatch.setattr(camera, requests, looked_at(getattr(camera, requests)))
    recorded = []
    for _ in range(2):
        start()
        for entry in writes:
            write(*entry)
        for _ in range(30):
            watch.look(camera.now_us, next(clock_ns))
        recorded.append([change for change in watch.waiting if isinstance(change, CameraSettings)])
        watch.waiting.clear()
        stop()
    (settings,), again = recorded
    acting = {name: factor for name, factor in camera.sensor_factors.items() if factor != 1}
    assert acting
    assert (settings.sensor_factors, settings.without_effect) == (acting, camera.without_effect)
    assert again == []


def test_default_biases_are_no_change():
    watch, host = ChangeWatch(camera := Davis346()), Host(camera)
    host.write_all(LIBCAER)
    watch.look(0, 0)
    assert not watch.pending
