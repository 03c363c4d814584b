"""`evstim picture RIG FILE`: the light and the events of a rig as PNG."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from emulator.cli.failures import failures
from emulator.cli.output import GOOD, console, print_json
from emulator.light import Light
from emulator.report.preview import event_picture, save_png
from emulator.rig.loading import Rig, load_rig
from emulator.run.assembly import build_pictures, build_sensor
from emulator.run.scene_assembly import build_scene
from firmware_protocol.events import Events, empty_events

__all__ = ["look", "picture"]


def picture(
    rig: str,
    file: Path,
    /,
    *,
    at_s: float = 0.5,
    window_ms: float = 20.0,
    brightness: float = 0.25,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Write a PNG of a rig: its light, dimmed, with ON events in green and OFF events in red.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one.
    file
        PNG file to write.
    at_s
        Stream time of the picture, seconds.
    window_ms
        Draw the events of this time before it, milliseconds.
    brightness
        Level of the brightest light, as a share of white.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures():
        light, events = look(load_rig(rig), at_s, window_ms)
        save_png(file, event_picture(light, events, dimming=brightness))
    if json:
        print_json({"rig": rig, "file": file, "events": len(events)})
    else:
        console.print(f"{file}: {len(events)} events of {window_ms:g} ms over the light at {at_s:g} s")
    return GOOD


def look(rig: Rig, at_s: float, window_ms: float) -> tuple[Light, Events]:
    """Run the scene and the sensor alone up to `at_s`; returns the light then and the events of the window before."""
    sensor = build_sensor(rig, rig.camera.sensor)
    step_ns, end_ns = rig.run.step_us * 1000, round(at_s * 1e9)
    # The filter has settled and the window is full after this long; what came before would change nothing visible.
    start_ns = max(0, end_ns - round(window_ms * 1e6) - 50 * step_ns)
    batches = [empty_events()]
    with build_scene(rig) as scene:
        picture = build_pictures(rig, scene)
        picture.draw(start_ns)
        sensor.reset(picture.light, start_ns)
        for t_ns in range(start_ns + step_ns, end_ns + 1, step_ns):
            picture.draw(t_ns)
            batches.append(sensor.expose(picture.light, t_ns, picture.rate, picture.pixel_light))
    events = np.concatenate(batches)
    return picture.light, events[events["t"] >= max(0, end_ns // 1000 - round(window_ms * 1000))]
