"""neuromorphic_drivers reads a SilkyEvCam VGA; with --settings each bias is changed while it streams, and set back."""

from __future__ import annotations

from dataclasses import fields, replace
from importlib.metadata import version
from itertools import count

import neuromorphic_drivers as nd
from collecting import Collector, arguments, parser
from neuromorphic_drivers.generated.devices import centuryarks_vga as vga


def main() -> None:
    options_parser = parser()
    options_parser.add_argument("--settings", action="store_true", help="change biases while it streams")
    options = arguments(options_parser)
    collector = Collector(options)
    discovered = [device.serial for device in nd.list_devices()]
    configuration = vga.Configuration()
    names = [bias.name for bias in fields(vga.Biases)]
    changes = [
        replace(configuration, biases=replace(configuration.biases, **{n: getattr(configuration.biases, n) + 1}))
        for n in names
    ]
    changes = [*changes, configuration] if options.settings else []
    change_at = count(0, options.count // 20)
    change_next, changes_made, running = next(change_at), 0, True
    with nd.open(configuration, iterator_timeout=0.1) as camera:
        about = {"serial": camera.serial(), "name": camera.name().value, "version": version("neuromorphic_drivers")}
        while running and (changes or not collector.done):
            try:
                _status, packet = next(camera)
            except RuntimeError:  # the camera was unplugged
                running = False
                continue
            if packet is None:
                continue
            if collector.counts["events"] > change_next and changes:
                camera.update_configuration(changes.pop(0))
                change_next, changes_made = next(change_at), changes_made + 1
            if packet.polarity_events is not None:
                events = packet.polarity_events
                collector.add(events["t"], events["x"], events["y"], events["on"])
        # Before the camera is closed: after an unplugging, closing may end the process (see environments.py).
        collector.report(running=running, discovered=discovered, changes=changes_made, **about)


if __name__ == "__main__":
    main()
