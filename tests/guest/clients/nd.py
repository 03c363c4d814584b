"""neuromorphic_drivers, the community's driver in Rust."""

from __future__ import annotations

from importlib.metadata import version

import neuromorphic_drivers as nd
from collecting import Collector, arguments
from register import write_registers

EXTERNAL_INPUT = 4
DETECT = (1, 2, 3, 0)  # rising, falling, pulses, run
KINDS = {0: 3, 1: 2, 2: 4}  # its polarity of a trigger: falling, rising, pulse


def main() -> None:
    options = arguments()
    collector = Collector(options)
    discovered = [device.serial for device in nd.list_devices()]
    running, overflows = True, 0
    with nd.open(nd.inivation_davis346.Configuration(), iterator_timeout=0.1) as camera:
        seen = {"serial": camera.serial(), "name": camera.name().value, "connection": camera.connection().value}
        if options.triggers:
            write_registers(EXTERNAL_INPUT, DETECT, 1)
        while running and not collector.done:
            try:
                _status, packet = next(camera)
            except RuntimeError:  # the camera was unplugged
                running = False
                continue
            if packet is None:
                continue
            for trigger in packet.trigger_events if packet.trigger_events is not None else ():
                collector.add_trigger(int(trigger["t"]), KINDS[int(trigger["polarity"])])
            for frame in packet.frames if options.frames and packet.frames is not None else ():
                collector.add_frame(int(frame.t), frame.pixels)
            if packet.polarity_events is None:
                continue
            events = packet.polarity_events
            overflows += len(packet.polarity_events_overflow_indices or ())
            collector.add(events["t"], events["x"], events["y"], events["on"])
        # Before the camera is closed: after an unplugging, closing may end the process (see environments.py).
        seen |= {"version": version("neuromorphic_drivers"), "discovered": discovered, "overflows": overflows}
        collector.report(running=running, **seen)


if __name__ == "__main__":
    main()
