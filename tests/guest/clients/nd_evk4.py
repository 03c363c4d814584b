"""neuromorphic_drivers reads a board of Prophesee's, by default an EVK4; --masks masks rows, columns and pixels of it.

With --settings it changes each bias, and of an EVK4 each mask, while it streams, and sets all back.
"""

from dataclasses import fields, replace
from importlib.metadata import version
from itertools import count

import neuromorphic_drivers as nd
from collecting import Collector, arguments, parser
from neuromorphic_drivers.generated.devices import prophesee_evk4 as evk4

RISING, FALLING = 2, 3
EVK4 = "prophesee_evk4"
MASKED_COLUMNS, MASKED_ROWS, MASKED_PIXEL = (100, 200), (40, 60), (640, 300)


def configuration(*, masks, limit):
    told = evk4.Configuration(biases=evk4.Biases(diff_on=20, refr=-10))
    if masks:
        lines = evk4.RowColumnMask(set=False)
        lines.set_x_range(*MASKED_COLUMNS, 1)
        lines.set_y_range(*MASKED_ROWS, 1)
        pixels = nd.PropheseeEvk4PixelMask()
        pixels.set(5, *MASKED_PIXEL)
        told.x_mask, told.y_mask, told.pixel_mask = lines.x_mask(), lines.y_mask(), pixels.pixel_mask()
    if limit:
        told.rate_limiter = evk4.RateLimiter(reference_period_us=200, maximum_events_per_period=limit)
    return told


def changed(told):
    """Each bias and each mask changed alone, and at the last the configuration as it was."""
    for bias in fields(told.biases):
        value = getattr(told.biases, bias.name) + 1
        yield replace(told, biases=replace(told.biases, **{bias.name: value}))
    masked = configuration(masks=True, limit=0)
    for name in ("x_mask", "y_mask", "pixel_mask") if isinstance(told, evk4.Configuration) else ():
        yield replace(told, **{name: getattr(masked, name)})
    yield told


def main():
    asked = parser()
    asked.set_defaults(device=EVK4)
    asked.add_argument("--masks", action="store_true", help="mask rows, columns and a pixel")
    asked.add_argument("--limit", type=int, default=0, help="events per 200 us that the rate control lets by")
    asked.add_argument("--settings", action="store_true", help="change biases and masks while it streams")
    options = arguments(asked)
    collector = Collector(options)
    discovered = [device.serial for device in nd.list_devices()]
    running, overflows = True, 0
    is_evk4 = options.device == EVK4
    told = getattr(nd, options.device).Configuration()
    if is_evk4:
        told = configuration(masks=options.masks, limit=options.limit)
    changes = list(changed(told)) if options.settings else []
    change_at = count(0, options.count // 20)  # all changes are made in the first 17 of 20 parts
    change_next, changes_made = next(change_at), 0
    with nd.open(told, iterator_timeout=0.1) as camera:
        seen = {"serial": camera.serial(), "name": camera.name().value, "connection": camera.connection().value}
        # Before any update: the driver's own thread writes it with no lock, and takes answers that others wait for.
        if is_evk4:
            seen |= {"celsius": camera.temperature_celsius(), "light": camera.illuminance()}
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
            if is_evk4 and packet.trigger_events is not None:
                for trigger in packet.trigger_events:
                    collector.add_trigger(int(trigger["t"]), RISING if trigger["rising"] else FALLING)
            if packet.polarity_events is not None:
                events = packet.polarity_events
                overflows += len(packet.polarity_events_overflow_indices or ())
                collector.add(events["t"], events["x"], events["y"], events["on"])
        if running and is_evk4:
            told.biases.diff_on = 0x70
            camera.update_configuration(told)
        # Before the camera is closed: after an unplugging, closing may end the process (see environments.py).
        seen |= {"version": version("neuromorphic_drivers"), "discovered": discovered, "overflows": overflows}
        seen["changes"] = changes_made
        collector.report(running=running, **seen)


if __name__ == "__main__":
    main()
