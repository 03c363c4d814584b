"""Make the pictures of the README and the docs with the program itself:  python docs/make_pictures.py

The pictures of a report and of a campaign's report also need Chromium:  python docs/make_pictures.py report campaign
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from emulator.cli.picture import PictureOptions, looks
from emulator.report.pictures import Rgb, event_picture, save_png
from emulator.rig.loading import load_rig

PICTURES = Path(__file__).parent / "pictures"

# Rig, second of the run, milliseconds of events, brightness of white, for the page on scenes.
SCENES = (
    ("itokawa", 6.0, 30.0, 0.6),
    ("eros-flyover", 120.0, 30.0, 0.6),
    ("rendezvous", 100.0, 30.0, 0.6),
    ("malapert", 12.0, 40.0, 0.5),
    ("stars", 3.0, 300.0, 1.0),
)


def draw(rig: str, at_s: float, window_ms: float, dimming: float = 0.6) -> Rgb:
    """Return a rig's picture at twice the sensor's size."""
    _, light, events = next(looks(load_rig(rig), PictureOptions(at_s, seconds=0.0), window_ms))
    picture = event_picture(light, events, dimming=dimming)
    return np.asarray(picture.repeat(2, axis=0).repeat(2, axis=1))


EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()"]
# The rig `eros` on a free port, with room for a busy machine, triggers, a fault and two rules of its own.
REPORTED = (
    ("lead_us = 100000", "lead_us = 900000\nmax_late_share = 0.05"),
    ("port = 3240", "port = 0"),
    (
        'busid = "1-1"\n',
        'busid = "1-1"\n[trigger]\nperiod_ms = 700\n[[faults]]\nkind = "usb_silence"\nat_s = 5.0\nfor_s = 0.5\n'
        "[verdict]\nmin_rate_hz = 1000\nmax_drop = 0.1\n",
    ),
)


def draw_report(seconds: float = 10.0, height_px: int = 2375) -> None:
    """Write the picture of a report, of a run with a host that reads its camera."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        rig, ready, page = folder / "eros.toml", folder / "ready.json", folder / "out" / "report.html"
        text = (Path(__file__).parents[1] / "rigs" / "eros.toml").read_text(encoding="utf-8")
        for old, new in REPORTED:
            text = text.replace(old, new)
        rig.write_text(text, encoding="utf-8")
        options = ["--seconds", f"{seconds:g}", "--report", str(page.parent), "--ready-file", str(ready)]
        with subprocess.Popen([*EVSTIM, "run", rig.name, *options], cwd=folder) as run:
            while run.poll() is None and not ready.exists():
                time.sleep(0.05)
            address = next(iter(json.loads(ready.read_text(encoding="utf-8"))["links"].values()))
            subprocess.run([*EVSTIM, "listen", "usb", "--usbip", address.partition(",")[0]], check=False)
        _photograph(page, PICTURES / "report.png", height_px)


def draw_campaign(height_px: int = 1396) -> None:
    """Write the picture of the example campaign's report."""
    example = Path(__file__).parents[1] / "examples" / "campaign"
    with tempfile.TemporaryDirectory() as made:
        folder = shutil.copytree(example, Path(made) / "campaign")
        subprocess.run([*EVSTIM, "campaign", "speed.toml"], cwd=folder, check=True)
        _photograph(folder / "speed" / "report.html", PICTURES / "campaign.png", height_px)


def _photograph(page: Path, picture: Path, height_px: int) -> None:
    """Write the upper part of a page as a picture, with Chromium."""
    with tempfile.TemporaryDirectory() as made:
        options = [f"--user-data-dir={made}", f"--window-size=1160,{height_px}", f"--screenshot={picture}"]
        browser = ["chromium", "--headless", "--no-sandbox", "--hide-scrollbars", *options]
        subprocess.run([*browser, page.as_uri()], check=True)


def main() -> None:
    """Write all pictures, or the named reports alone."""
    for name in sys.argv[1:]:
        {"report": draw_report, "campaign": draw_campaign}[name]()
    if sys.argv[1:]:
        return
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
