"""neuromorphic_drivers, the community's driver in Rust."""

import time
from importlib.metadata import version

import neuromorphic_drivers as nd
from collecting import Collector, arguments
from register import write_registers

EXTERNAL_INPUT = 4
DETECT = (1, 2, 3, 0)  # rising, falling, pulses, run
G_M_S2, DEGREES = 9.80665, 57.29577951308232
KINDS = {0: 3, 1: 2, 2: 4}  # its polarity of a trigger: falling, rising, pulse


def collect_triggers(triggers, collector):
    """Take triggers; their last byte is the polarity, which is declared as a flag for a DVXplorer and may be 2."""
    polarities = triggers.view("u1").reshape(len(triggers), -1)[:, -1]
    for t, polarity in zip(triggers["t"].tolist(), polarities.tolist(), strict=True):
        collector.add_trigger(t, KINDS[polarity])


def collect_imu(samples, collector):
    """Take samples in m/s2 and rad/s."""
    for one in samples:
        acceleration_g = (float(one[f"accelerometer_{axis}"]) / G_M_S2 for axis in "xyz")
        rate_deg_s = (float(one[f"gyroscope_{axis}"]) * DEGREES for axis in "xyz")
        collector.add_imu(int(one["t"]), *acceleration_g, float(one["temperature"]), *rate_deg_s)


def open_camera(options):
    """Open the first camera, with the detector of its external input on if triggers are asked for."""
    camera = open_driver(options.device, options.attempts)
    if options.triggers:
        write_registers(EXTERNAL_INPUT, DETECT, 1)
    return camera


def open_driver(device, attempts):
    """Open the first camera; where the driver finds none, a second later again."""
    try:
        return nd.open(getattr(nd, device).Configuration(), iterator_timeout=0.1)
    except RuntimeError:
        if attempts == 1:
            raise
    time.sleep(1.0)
    return open_driver(device, attempts - 1)


def take(camera, collector, options):
    """Take the next packet, if there is one in time, and return how often it tells of an overflow."""
    _status, packet = next(camera)
    if packet is None:
        return 0
    if packet.trigger_events is not None:
        collect_triggers(packet.trigger_events, collector)
    if options.imu and packet.imu_events is not None:
        collect_imu(packet.imu_events, collector)
    for frame in packet.frames if options.frames and packet.frames is not None else ():
        collector.add_frame(int(frame.t), frame.pixels)
    if packet.polarity_events is None:
        return 0
    events = packet.polarity_events
    collector.add(events["t"], events["x"], events["y"], events["on"])
    return len(packet.polarity_events_overflow_indices or ())


def main():
    options = arguments()
    collector = Collector(options)
    discovered = [device.serial for device in nd.list_devices()]
    running, overflows = True, 0
    with open_camera(options) as camera:
        seen = {"serial": camera.serial(), "name": camera.name().value, "connection": camera.connection().value}
        while running and not collector.done:
            try:
                overflows += take(camera, collector, options)
            except RuntimeError:  # the camera was unplugged
                running = False
        # Before the camera is closed: after an unplugging, closing may end the process (see environments.py).
        seen |= {"version": version("neuromorphic_drivers"), "discovered": discovered, "overflows": overflows}
        collector.report(running=running, **seen)


if __name__ == "__main__":
    main()
