"""`evstim picture` of recordings: the events of the window and the light of the frames, where they belong."""

import numpy as np
import pytest
from PIL import Image

from emulator.cli.app import _main
from firmware_protocol.events import EVENT
from firmware_protocol.recordings.part import Facts, Frame, Part
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS

pytestmark = pytest.mark.usefixtures("reads_here")
SIZE, ON, OFF, BLACK = (346, 260), (230, 159, 0), (86, 180, 233), (0, 0, 0)
START_US = 7_000_000  # a recording need not begin at zero
EVENTS = np.array(
    [(START_US, 1, 2, True), (START_US + 480_000, 30, 40, True), (START_US + 499_000, 50, 60, False),
     (START_US + 900_000, 70, 80, True)], EVENT,
)  # fmt: skip


def written(path, form, frames=()):
    file = RecordingFile(path, FORMATS[form], Facts(SIZE, streams=frozenset({"frames"} if frames else ())))
    file.write(Part(EVENTS, frames=frames))
    file.close()
    return path


def drawn(json_of, *arguments):
    """The answer of the command, and the first picture; small sensors are drawn twice as large."""
    answer = json_of(0, "picture", *arguments)
    with Image.open(arguments[1]) as image:
        return answer, np.asarray(image.convert("RGB"))[::2, ::2], getattr(image, "n_frames", 1)


def colours(picture):
    return [tuple(map(int, picture[y, x])) for x, y in ((1, 2), (30, 40), (50, 60), (70, 80))]


@pytest.mark.sampled
@pytest.mark.parametrize("form", FORMATS)
def test_a_picture_has_the_events_of_its_window(form, tmp_path, json_of):
    path = written(tmp_path / f"a{FORMATS[form].suffixes[0]}", form)
    answer, picture, _ = drawn(json_of, path, tmp_path / "a.png", "--window-ms", "50", "--size", "346x260")
    assert answer["events"] == 2
    assert colours(picture) == [BLACK, ON, OFF, BLACK]


def test_the_light_is_that_of_the_last_frame_before(tmp_path, json_of):
    grey = [np.full(SIZE[::-1], level, np.uint8) for level in (100, 200)]
    grey[0][:, :173] = 0
    frames = tuple(Frame(t, t, t + 10, grey[k]) for k, t in enumerate((START_US + 400_000, START_US + 600_000)))
    path = written(tmp_path / "a.aedat4", "aedat4", frames)
    picture = drawn(json_of, path, tmp_path / "a.png")[1]
    assert picture[100, 100].max() == 0
    assert picture[100, 300].min() > 50


def test_a_picture_beyond_the_end_is_of_the_end(tmp_path, json_of):
    path = written(tmp_path / "a.npz", "npz")
    picture = drawn(json_of, path, tmp_path / "a.png", "--at-s", "60", "--window-ms", "50")[1]
    assert colours(picture) == [BLACK, BLACK, BLACK, ON]


def test_a_movie_ends_with_the_recording(tmp_path, json_of):
    path = written(tmp_path / "a.raw", "evt3")
    answer, _, count = drawn(json_of, path, tmp_path / "a.gif", "--at-s", "0", "--seconds", "60")
    assert (answer["events"], count) == (len(EVENTS), 24)  # 0.9 s in steps of 40 ms, and the end


@pytest.mark.parametrize(("name", "content", "message"), [
    ("gone.aedat4", None, "No such file"),
    ("a.raw", b"nonsense", "none of the recordings that are read"),
    ("a.csv", b"t,x,y,on\n1,2,3,1\n", "give --size, such as 346x260"),
])  # fmt: skip
def test_what_cannot_be_drawn(name, content, message, tmp_path, capsys):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert _main(["picture", str(tmp_path / name), str(tmp_path / "a.png")]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
