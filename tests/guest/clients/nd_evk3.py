"""neuromorphic_drivers reads a Prophesee EVK3 HD."""

from __future__ import annotations

from importlib.metadata import version

import neuromorphic_drivers as nd
from collecting import Collector, arguments
from neuromorphic_drivers.generated.devices import prophesee_evk3_hd as evk3


def main() -> None:
    collector = Collector(arguments())
    discovered = [device.serial for device in nd.list_devices()]
    running = True
    with nd.open(evk3.Configuration(biases=evk3.Biases(diff_on=0x7F)), iterator_timeout=0.1) as camera:
        about = {"serial": camera.serial(), "name": camera.name().value, "version": version("neuromorphic_drivers")}
        while running and not collector.done:
            try:
                _status, packet = next(camera)
            except RuntimeError:  # the camera was unplugged
                running = False
                continue
            if packet is not None and packet.polarity_events is not None:
                events = packet.polarity_events
                collector.add(events["t"], events["x"], events["y"], events["on"])
        # Before the camera is closed: after an unplugging, closing may end the process (see environments.py).
        collector.report(running=running, discovered=discovered, **about)


if __name__ == "__main__":
    main()
