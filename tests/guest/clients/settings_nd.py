"""neuromorphic_drivers: every field of its configuration while all streams run, and back to what it was."""

from dataclasses import fields, replace
from functools import partial

import neuromorphic_drivers as nd
from changing import look, make_changes, take_settled
from collecting import Collector, arguments
from nd import open_camera, take
from register import write_registers

DAVIS = nd.inivation_davis346
APS, RUN = 2, 4
DEFAULT = DAVIS.Configuration()
OTHERS = {
    "region_of_interest": (DAVIS.RegionOfInterest(20, 30, 200, 150),),
    "pixel_mask": ((0x00010002, 0x00030004, 5, 6, 7, 8, 9, 10),),
    "activity_filter": (DAVIS.ActivityFilter(False, 4, True, 2), DAVIS.ActivityFilter(True, 4, True, 2)),
    "skip_events_every": (1, 3),
    "polarity_filter": tuple(kind for kind in DAVIS.PolarityFilter if kind is not DEFAULT.polarity_filter),
    "exposure_us": (1000, 12000),
    "frame_interval_us": (100_000, 0),
}


def configurations():
    """Each with one field that is not as the driver has it."""
    for bias in fields(DAVIS.Biases):
        value = getattr(DEFAULT.biases, bias.name) + 1
        yield f"biases.{bias.name} = {value}", replace(DEFAULT, biases=replace(DEFAULT.biases, **{bias.name: value}))
    for name, values in OTHERS.items():
        for value in values:
            yield f"{name} = {value}", replace(DEFAULT, **{name: value})


def changes(camera):
    """Every field, and at the last the driver's own configuration."""
    for name, configuration in (*configurations(), ("default", DEFAULT)):
        yield name, partial(update, camera, configuration)


def update(camera, configuration):
    """Change the configuration, and start the frames that the driver leaves off after a change of the region."""
    camera.update_configuration(configuration)
    write_registers(APS, (RUN,), 1)


def main():
    options = arguments()
    collector = Collector(options)
    with open_camera(options) as camera:
        take_some = partial(take, camera, collector, options)
        outcomes = make_changes(changes(camera), take_some, collector)
        getters = ("backlog", "overflow", "name", "properties", "serial", "biases_bounds", "connection", "orientation")
        outcomes += look((name, getattr(camera, name)) for name in (*getters, "imu_type"))
        take_settled(take_some, collector, options.timeout)
        named = {name for name, _ in configurations()}
        untried = [one.name for one in fields(DEFAULT) if not any(name.startswith(one.name) for name in named)]
        collector.report(running=True, changes=outcomes, untried=untried)


if __name__ == "__main__":
    main()
