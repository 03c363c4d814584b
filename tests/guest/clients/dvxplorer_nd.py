"""neuromorphic_drivers: settings of its DVXplorer configuration while all streams run, and back to what they were."""

from dataclasses import fields, replace
from functools import partial

import neuromorphic_drivers as nd
from changing import make_changes
from collecting import Collector, arguments
from nd import open_camera, take

MODEL = nd.inivation_dvxplorer
FPS = MODEL.ReadoutFramesPerSecond
DEFAULT = MODEL.Configuration(readout_frames_per_second=FPS.VARIABLE5000)
BIASES = {"on": 6, "off": 6, "amp": 6, "sf": 1, "nrst": True, "log": True, "log_a": False, "log_d": 2}


def changes(camera):
    for bias in fields(MODEL.Biases):
        changed = replace(DEFAULT, biases=replace(DEFAULT.biases, **{bias.name: BIASES[bias.name]}))
        yield f"biases.{bias.name}", partial(camera.update_configuration, changed)
    for rate in (FPS.VARIABLE2000, FPS.CONSTANT1000, FPS.VARIABLE15000):
        changed = replace(DEFAULT, readout_frames_per_second=rate)
        yield f"{rate}", partial(camera.update_configuration, changed)
    yield "default", partial(camera.update_configuration, DEFAULT)


def main():
    options = arguments()
    collector = Collector(options)
    discovered = [device.serial for device in nd.list_devices()]
    with open_camera(options) as camera:
        take_some = partial(take, camera, collector, options)
        while not collector.counts["events"]:
            take_some()
        outcomes = make_changes(changes(camera), take_some, collector)
        while not collector.done:
            take_some()
        collector.report(running=True, discovered=discovered, changes=outcomes)


if __name__ == "__main__":
    main()
