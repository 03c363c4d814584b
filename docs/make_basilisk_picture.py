"""Make the picture of the page on Basilisk:  python docs/make_basilisk_picture.py PYTHON_WITH_BSK"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from emulator.report.pictures import Rgb, captioned, event_picture, grey_png, save_png
from emulator.rig.loading import load_rig
from emulator.run.assembly import build_scene, build_session, schedule
from emulator.run.basilisk import BasiliskRun, connected
from firmware_protocol.events import Events, empty_events
from transports.link.pacing import MonotonicClock
from transports.vizard import VizardServer

PAGE = Path(__file__).parent
EXAMPLE = PAGE.parent / "examples" / "basilisk"
AT_S = (0.5, 1.5, 7.9)
WINDOW_US = 20_000


def draw(server: VizardServer, moments_s: tuple[float, ...]) -> list[Rgb]:
    """Run the example against the simulation that has been started; return the light and events at some moments."""
    rig, paths = connected(load_rig(str(EXAMPLE / "eros.toml")))
    due, pictures, seen = list(moments_s), list[Rgb](), empty_events()
    with build_scene(rig) as scene:
        session = build_session(rig, scene, [], MonotonicClock())

        def take(events: Events) -> None:
            nonlocal seen
            now_us = session.t_ns // 1000
            seen = np.concatenate([seen, events])
            seen = seen[seen["t"] >= now_us - WINDOW_US]
            if due and now_us >= due[0] * 1e6:
                picture = event_picture(session.light, seen, white=1.0, dimming=0.8)
                pictures.append(captioned(picture, f"{due.pop(0):g} s, events of {WINDOW_US // 1000} ms"))

        run = BasiliskRun(server, paths, lambda light: grey_png(light, 1.0), MonotonicClock())
        session.run(dataclasses.replace(schedule(rig), simulation=run), on_events=take)
    return pictures


def main(python: str) -> None:
    """Write the picture."""
    server = VizardServer("127.0.0.1", 0)
    port = server.address.rpartition(":")[2]
    with tempfile.TemporaryDirectory() as folder:
        command = [python, EXAMPLE / "simulation.py", "--port", port, "--seconds", "8"]
        with subprocess.Popen(command, cwd=folder) as simulation:
            try:
                pictures = draw(server, AT_S)
            finally:
                simulation.kill()
                server.close()
    gap = np.full((pictures[0].shape[0], 8, 3), 255, np.uint8)
    joined = np.concatenate([part for picture in pictures for part in (picture, gap)][:-1], axis=1)
    save_png(PAGE / "pictures" / "basilisk.png", joined)


if __name__ == "__main__":
    main(sys.argv[1])
