"""Make the pictures of the README and the docs with the program itself:  python docs/make_pictures.py"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from emulator.cli.picture import look
from emulator.report.pictures import Rgb, event_picture, save_png
from emulator.rig.loading import load_rig

PICTURES = Path(__file__).parent / "pictures"

# Rig, second of the run, milliseconds of events, brightness of white, for the page on scenes.
SCENES = (
    ("itokawa", 6.0, 30.0, 0.6),
    ("eros-flyover", 20.0, 30.0, 0.6),
    ("rendezvous", 100.0, 30.0, 0.6),
    ("malapert", 12.0, 40.0, 0.5),
    ("stars", 3.0, 300.0, 1.0),
)


def draw(rig: str, at_s: float, window_ms: float, dimming: float = 0.6) -> Rgb:
    """Return a rig's picture at twice the sensor's size."""
    picture = event_picture(*look(load_rig(rig), at_s, window_ms), dimming=dimming)
    return np.asarray(picture.repeat(2, axis=0).repeat(2, axis=1))


def main() -> None:
    """Write all pictures."""
    PICTURES.mkdir(exist_ok=True)
    eros, board = draw("eros", 8.0, 60.0), draw("checkerboard", 0.5, 10.0)
    gap = np.full((eros.shape[0], 16, 3), 255, np.uint8)
    save_png(PICTURES / "eros.png", eros)
    save_png(PICTURES / "checkerboard.png", board)
    scenes = {rig: draw(rig, at_s, window_ms, dimming) for rig, at_s, window_ms, dimming in SCENES}
    for rig, picture in scenes.items():
        save_png(PICTURES / f"{rig}.png", picture)
    save_png(PICTURES / "readme.png", np.concatenate([scenes["malapert"], gap, scenes["itokawa"]], axis=1))


if __name__ == "__main__":
    main()
