"""EventCV, a library of computer vision with the driver of neuromorphic_drivers 0.17 inside, reads a Prophesee EVK4."""

from importlib import import_module
from importlib.metadata import version

from collecting import Collector, arguments, parser

ROI = (200, 100, 800, 500)  # first column, first row, width, height
WINDOW_EVENTS = 10_000


def main():
    asked = parser()
    asked.add_argument("--roi", action="store_true", help="keep a rectangle alone")
    options = arguments(asked)
    collector = Collector(options)
    loading = import_module("eventcv.load")  # `eventcv.load` is a function
    discovered = [(camera["kind"], camera["serial"]) for camera in loading.list_cameras()]
    with loading.stream(max_events=WINDOW_EVENTS, roi=ROI if options.roi else None) as camera:
        seen = {"serial": camera.serial, "name": camera.name, "overflows": camera.n_overflows, "roi": str(camera.roi)}
        while not collector.done:
            window = camera.read(timeout_ms=1000)
            if window is None:
                continue
            x, y, t, on = window.numpy().T
            collector.add(t, x, y, on)
    collector.report(running=True, version=version("eventcv"), discovered=discovered, **seen)


if __name__ == "__main__":
    main()
