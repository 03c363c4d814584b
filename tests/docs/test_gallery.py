"""The gallery has every shipped rig, with files that are there and small."""

import re
import runpy
from pathlib import Path

from PIL import Image

from emulator.rig.loading import shipped_rigs

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "gallery.md").read_text(encoding="utf-8")
FILES = set(re.findall(r"\]\((gallery/[^)]+)\)", PAGE))


def test_each_shipped_rig_has_its_section():
    assert sorted(re.findall(r"^### (\S+)$", PAGE, re.MULTILINE)) == sorted(shipped_rigs())


def test_the_page_is_what_its_script_makes():
    script = runpy.run_path(str(DOCS / "make_gallery.py"))
    assert script["page"]() == PAGE, "run: python docs/make_gallery.py"


def test_the_files_are_those_of_the_page():
    assert {path.relative_to(DOCS).as_posix() for path in (DOCS / "gallery").iterdir()} == FILES
    assert sum((DOCS / name).stat().st_size for name in FILES) < 6_000_000


def test_movies_move_and_pictures_show_events():
    for name in FILES:
        with Image.open(DOCS / name) as picture:
            assert (getattr(picture, "n_frames", 1) > 1) == ("-movie" in name), name
            assert picture.width <= 1400, name
