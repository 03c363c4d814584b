"""Write the gallery of shipped rigs, its pictures and its movies:  python docs/make_gallery.py [RIG ...]

Without names all pictures are drawn (some minutes); the page is written each time.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from emulator.cli.picture import PictureOptions, looks
from emulator.light import Light
from emulator.report.pictures import Rgb, event_picture, white_of
from emulator.rig.loading import load_rig
from firmware_protocol.events import Events

PAGE = Path(__file__).with_name("gallery.md")
FOLDER = PAGE.with_name("gallery")

_WIDEST_PX = 700  # a sensor that is wider is drawn at a half, so that files stay small
_PLAYED_FPS = 10
_QUALITY = (
    60  # of lossy WebP; the file without loss is taken where it is not much longer, for the colours of single pixels
)
_LOSSLESS_BYTES = 2  # times those of the lossy file


@dataclass(frozen=True)
class Shot:
    """Content of one picture and one movie.

    Attributes
    ----------
    rig
        Name of a shipped rig.
    at_s
        Stream time of the picture, and of the movie's beginning, seconds.
    window_ms
        Time of the events in each picture, milliseconds.
    pictures
        Number of pictures of the movie.
    fps
        Pictures for each second of stream time; the movie is played at ten a second.
    white
        Level of the brightest light below the events, as a share of white; twice this without them.
    like
        Rig of the same scene and sensor, the files of which are shown: it has another link alone.
    """

    rig: str
    at_s: float
    window_ms: float
    pictures: int = 20
    fps: int = 10
    white: float = 0.5
    like: str = ""


GALLERY: dict[str, tuple[Shot, ...]] = {
    "Asteroids": (
        Shot("eros", 8.0, 60.0),
        Shot("eros-flyover", 120.0, 60.0),
        Shot("itokawa", 6.0, 60.0),
        Shot("itokawa-gige", 6.0, 40.0, pictures=10),
    ),
    "Landing and rendezvous": (
        Shot("malapert", 12.0, 40.0),
        Shot("rendezvous", 100.0, 60.0),
    ),
    "Stars": (
        Shot("stars", 3.0, 400.0, fps=5, white=1.0),
        Shot("stars-davis240c", 3.0, 400.0, fps=5, white=1.0),
        Shot("stars-evk4", 3.0, 200.0, fps=5, white=1.0),
        Shot("stars-silkyevcam-vga", 3.0, 400.0, fps=5, white=1.0),
        Shot("stars-genx320", 3.0, 400.0, fps=5, white=1.0),
        Shot("stars-dvxplorer", 3.0, 400.0, fps=5, white=1.0),
        Shot("stars-dvxplorer-micro", 3.0, 400.0, fps=5, white=1.0, like="stars-dvxplorer"),
        Shot("stars-gige", 3.0, 200.0, fps=5, white=1.0, like="stars-evk4"),
        Shot("stars-stereo", 8.0, 400.0, fps=2, white=1.0),
        Shot("stars-two-families", 8.0, 400.0, fps=2, white=1.0),
        Shot("stars-dv", 3.0, 400.0, fps=5, white=1.0, like="stars"),
        Shot("stars-udp", 3.0, 400.0, fps=5, white=1.0, like="stars"),
        Shot("stars-ros2", 3.0, 400.0, fps=5, white=1.0, like="stars"),
        Shot("stars-limit", 4.0, 500.0, pictures=8, fps=2, white=0.25),
        Shot("stars-limit-gen3", 4.0, 1000.0, pictures=10, fps=2, white=0.25),
    ),
    "Patterns for the test of links": (
        Shot("checkerboard", 0.5, 10.0, fps=25),
        Shot("loopback", 0.5, 10.0, fps=25, like="checkerboard"),
        Shot("serial-demo", 0.5, 100.0),
        Shot("serial-faults", 0.5, 100.0, like="serial-demo"),
        Shot("can-demo", 0.5, 200.0),
    ),
}

_BEGINNING = """# Gallery of rigs

All rigs that evstim ships; `evstim run NAME` starts one. The picture has the light on the left and the events of the
same instant on the right; the movie has the events over the dimmed light. ON events are orange, OFF events blue. Of a
rig with two cameras the first one is drawn; a sensor wider than 700 pixels at half its size: the brightest light and
the last event of four pixels. `python docs/make_gallery.py` makes this page; `evstim picture NAME FILE.png` or
`FILE.gif` draws one rig at any time and length. [Scenes](scenes.md) explains how to change one.
"""


def page() -> str:
    """Return the text of the page."""
    groups = (f"## {title}\n\n" + "\n".join(map(_section, shots)) for title, shots in GALLERY.items())
    return "\n".join([_BEGINNING, *groups])


def _section(shot: Shot) -> str:
    title = load_rig(shot.rig).title
    if shot.like:
        return f"""### {shot.rig}

{title}. Its pictures are those of `{shot.like}`.
"""
    length_s, played_s = shot.pictures / shot.fps, shot.pictures / _PLAYED_FPS
    return f"""### {shot.rig}

{title}. At {shot.at_s:g} s, events of {shot.window_ms:g} ms; movie of {length_s:g} s in {played_s:g} s.

![{shot.rig}: light and events](gallery/{shot.rig}.webp)
![{shot.rig}: movie of the events](gallery/{shot.rig}-movie.webp)
"""


def draw(shot: Shot) -> None:
    """Write the picture and the movie of a rig."""
    FOLDER.mkdir(exist_ok=True)
    show = PictureOptions(shot.at_s, shot.window_ms, (shot.pictures - 0.5) / shot.fps, fps=shot.fps)
    seen = [_smaller(light, events) for _, light, events in looks(load_rig(shot.rig), show, shot.window_ms)]
    white = white_of(seen[0][0])
    _save(FOLDER / f"{shot.rig}.webp", [_beside(*seen[0], min(1.0, 2 * shot.white))])
    _save(FOLDER / f"{shot.rig}-movie.webp", [event_picture(*pair, white=white, dimming=shot.white) for pair in seen])


def _smaller(light: Light, events: Events) -> tuple[Light, Events]:
    """Return a wide picture at half its size: the brightest light and the events of each four pixels."""
    height, width = light.shape
    if width <= _WIDEST_PX:
        return light, events
    events = events.copy()
    events["x"] //= 2
    events["y"] //= 2
    return light.reshape(height // 2, 2, width // 2, 2).max(axis=(1, 3)), events


def _beside(light: Light, events: Events, white: float) -> Rgb:
    """Return the light, and the events alone on its right."""
    scene = event_picture(light, events[:0], dimming=white)
    alone = event_picture(np.zeros_like(light), events)
    return np.concatenate([scene, np.full((len(scene), 6, 3), 128, np.uint8), alone], axis=1)


def _save(path: Path, pictures: Sequence[Rgb]) -> None:
    """Write one picture, or several as an animation, as WebP."""
    first, *rest = (Image.fromarray(picture) for picture in pictures)
    options = {"save_all": True, "append_images": rest, "duration": 1000 // _PLAYED_FPS, "loop": 0} if rest else {}
    lossy, exact = io.BytesIO(), io.BytesIO()
    first.save(lossy, "WEBP", quality=_QUALITY, method=4, **options)
    first.save(exact, "WEBP", lossless=True, method=4, **options)
    is_exact = exact.tell() < _LOSSLESS_BYTES * lossy.tell()
    path.write_bytes((exact if is_exact else lossy).getvalue())


def main(names: Sequence[str]) -> None:
    """Draw the named rigs, all of them without names, and write the page."""
    for shot in (shot for shots in GALLERY.values() for shot in shots):
        if not shot.like and (not names or shot.rig in names):
            print(f"{shot.rig} ...", flush=True)  # noqa: T201
            draw(shot)
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
