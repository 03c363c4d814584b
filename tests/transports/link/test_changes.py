"""Changes of a camera: settings between two writes are none, and those for a busy session are never lost."""

from firmware_protocol.davis346.device import Davis346
from firmware_protocol.device.event_device import HostAdjusted
from transports.link.report import CameraSettings, ChangeWatch, Occurrence
from transports.usb.davis_host import DavisHost
from transports.usb.loopback import DirectHost

MS = 1_000_000


class Device(HostAdjusted):
    """What a watch looks at: every look finds a new version of its settings."""

    set_by = "telecommand"

    def __init__(self):
        self.commands, self.factors, self.looks = (), {}, 0

    @property
    def settings_version(self):
        self.looks += 1
        return self.looks

    @property
    def sensor_factors(self):
        return self.factors

    def take_commands(self):
        commands, self.commands = self.commands, ()
        return commands


def watched():
    device = Device()
    return device, ChangeWatch(device)


def test_settings_behind_a_flood_of_telecommands_are_the_last_ones():
    device, watch = watched()
    for k in range(300):
        device.commands = tuple(f"SetRegion({k}, {n})" for n in range(10))
        device.factors = {"threshold_on": 1.0 + k / 100}
        watch.look(k, k * MS)
    device.commands = ("SetRegion(0, 0)",)
    watch.look(299, 400 * MS)
    assert len(watch.waiting) <= 1001
    settings = [one for one in watch.waiting if isinstance(one, CameraSettings)]
    assert settings[-1] == CameraSettings(299, "telecommand", {"threshold_on": 3.99}, {})


def test_a_host_that_never_pauses_is_followed_all_the_same():
    device, watch = watched()
    for k in range(100):
        device.factors = {"threshold_on": 2.0 + k / 100}
        watch.look(1000 * k, k * MS)
    assert [settings.t_us for settings in watch.waiting] == [20_000, 41_000, 62_000, 83_000]
    assert [settings.sensor_factors["threshold_on"] for settings in watch.waiting] == [2.2, 2.41, 2.62, 2.83]


def test_what_found_no_room_is_counted_when_there_is_room_again():
    device, watch = watched()
    device.commands = tuple(map(str, range(1500)))
    watch.look(1, 0)
    assert len(watch.waiting) == 1000
    watch.waiting.clear()
    device.commands = ("last",)
    watch.look(2, 0)
    assert list(watch.waiting) == [
        Occurrence(2, "telecommand", "500 more, not listed"), Occurrence(2, "telecommand", "last"),
    ]  # fmt: skip


class Counting(Davis346):
    """Camera that counts how often its factors are read."""

    reads = 0

    @property
    def sensor_factors(self):
        self.reads += 1
        return super().sensor_factors


def test_a_camera_that_nobody_writes_to_is_compared_once():
    device = Counting()
    watch = ChangeWatch(device)
    for t_us in range(100):
        watch.look(t_us, 0)
    assert device.reads == 1
    DavisHost(DirectHost(device)).write_register(5, 12, 1)  # OffBn
    assert watch.is_behind
    watch.look(100, 0)
    assert watch.pending
    watch.look(101, 2 * MS)
    assert not watch.is_behind
    assert device.reads == 2
    assert [type(one) for one in watch.waiting] == [CameraSettings]
