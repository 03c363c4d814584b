"""The driver of the DVXplorer: identity, streams with samples and edges, unplugging in every state, other devices."""

import dataclasses

import numpy as np
import pytest

from evstim.testing.link_contract import event_stream
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.dvxplorer.device import Dvxplorer, DvxplorerSettings
from firmware_protocol.dvxplorer.micro import DvxplorerMicro, DvxplorerMicroSettings
from firmware_protocol.dvxplorer.registers import SYSTEM
from firmware_protocol.events import EDGE
from tests.made_events import samples_at
from transports.usb.cameras import driver_of
from transports.usb.davis_host import DavisHost
from transports.usb.dvxplorer_host import DvxplorerHost
from transports.usb.host import StreamSettings, UnsuitableDevice
from transports.usb.loopback import DirectHost

SETTINGS = DvxplorerSettings(serial="00000042", start_delay_us=0, imu_unit=3)


def samples(count, start_us):
    return samples_at(start_us + np.arange(count), np.arange(7 * count).reshape(count, 7))


def edges(*moments):
    out = np.zeros(len(moments), EDGE)
    out["t"], out["kind"] = zip(*moments, strict=True)
    return out


def test_all_streams_come_as_they_were_sent():
    camera = Dvxplorer(SETTINGS)
    camera.advance(7000)
    host = DvxplorerHost(DirectHost(camera))
    host.start(StreamSettings(edges=True, imu=True))
    shown, moved = event_stream(2000, 7000), samples(20, 7100)
    camera.offer_readings(ReadingKind.IMU, moved)
    camera.offer_edges(edges((7200, 2), (7300, 3)))
    camera.offer(shown)
    camera.advance(20_000)
    parts = []
    while (part := host.read(0.0)) is not None:
        parts.append(part)
    seen, felt, marks = np.concatenate(parts), host.take_imu(), host.take_edges()
    for one in (seen, felt, marks):
        one["t"] += np.uint64(7000)
    assert np.array_equal(seen, shown)
    assert felt.tobytes() == moved.tobytes()
    assert [(t, kind) for t, kind, _, _ in marks.tolist() if kind != 4] == [(7200, 2), (7300, 3)]
    assert len(host.take_edges()) == len(host.take_imu()) == 0
    assert host.faults.total == 0
    host.close()
    assert not camera.streaming


def test_each_driver_refuses_the_other_camera_and_old_ones():
    with pytest.raises(UnsuitableDevice, match=r"152a:8419 is not a DAVIS \(152a:841a\)"):
        DavisHost(DirectHost(Dvxplorer(SETTINGS)))
    old = dataclasses.replace(SETTINGS, bcd_device=0x0308)
    with pytest.raises(UnsuitableDevice, match="firmware version 8; at least 9"):
        driver_of(DirectHost(Dvxplorer(old)))
    old = dataclasses.replace(SETTINGS, system=dataclasses.replace(SYSTEM, logic_patch=3))
    with pytest.raises(UnsuitableDevice, match="logic patch version 3; at least 4"):
        driver_of(DirectHost(Dvxplorer(old)))


def micro(**changes):
    return DvxplorerMicro(DvxplorerMicroSettings(serial="00000042", start_delay_us=0, imu_unit=3, **changes))


CAMERAS = {
    "dvxplorer": lambda: Dvxplorer(SETTINGS),
    "micro": lambda: micro(),
    "micro_firmware9": lambda: micro(bcd_device=0x0409),
}


def begun(camera, until):
    """A host that goes as far as `until`: 0 attached, 1 configured, 2 started, 3 started and reading."""
    host = DirectHost(camera)
    if until:
        driver = driver_of(host)
        if until > 1:
            driver.start(StreamSettings(edges=True, imu=True))
        if until > 2:
            camera.offer(event_stream(100, camera.now_us))
            driver.read(0.0)
    return host


@pytest.mark.parametrize("model", CAMERAS)
@pytest.mark.parametrize("until", range(4))
def test_a_cable_pulled_in_any_state_leaves_clear_counts_and_the_next_host_starts(model, until):
    camera = CAMERAS[model]()
    host = begun(camera, until)
    now_us = camera.now_us
    camera.offer_readings(ReadingKind.IMU, samples(5, now_us + 10))
    camera.offer_edges(edges((now_us + 10, 2)))
    camera.offer(event_stream(1000, now_us))
    host.close()  # nothing was read
    fates = camera.counters
    fate = fates.flushed if until > 1 else fates.not_running
    assert fate == 1000
    assert fates.balanced
    assert fates.edges.balanced
    assert fates.readings["imu"].balanced
    assert fates.queued == 0
    again = driver_of(DirectHost(camera))
    again.start()
    shown = event_stream(50, camera.now_us)
    camera.offer(shown)
    assert len(again.read(0.0)) == 50
    assert camera.counters.balanced


def test_a_micro_is_identified_by_its_hardware_and_its_samples_get_the_time_of_the_stream():
    camera = micro()
    host = driver_of(DirectHost(camera))
    assert (host.model, host.info.firmware, host.info.serial) == ("DVXplorer Micro", 10, "00000042")
    host.start(StreamSettings(imu=True))
    camera.offer_readings(ReadingKind.IMU, moved := samples(3, camera.now_us + 1))
    camera.offer(shown := event_stream(1000))
    camera.advance(20_000)
    parts = []
    while (part := host.read(0.0)) is not None:
        parts.append(part)
    seen, felt = np.concatenate(parts), host.take_imu()
    assert sorted(seen[["x", "y", "on"]].tolist()) == sorted(shown[["x", "y", "on"]].tolist())
    assert (felt["scale"].tolist(), felt["counts"].tolist()) == (moved["scale"].tolist(), moved["counts"].tolist())
    assert set(felt["t"].tolist()) == {20_000}
    assert host.faults.total == 0
    old = dataclasses.replace(camera.settings, bcd_device=0x0407)
    with pytest.raises(UnsuitableDevice, match="firmware version 7; at least 8"):
        driver_of(DirectHost(DvxplorerMicro(old)))
