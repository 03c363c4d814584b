"""Videos: straight lines in log light between frames, every depth, and what is broken is told."""

import math
import re
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from emulator.light import SceneError
from emulator.scene.video.video import Video, VideoParameters, coarsest_level, linear_light, read_frames, read_video

pytestmark = pytest.mark.usefixtures("reads_here")

SIZE = (12, 8)


@pytest.fixture
def array(tmp_path):
    def write(levels):
        path = tmp_path / "frames.npy"
        np.save(path, levels)
        return str(path)

    return write


def drawn(video, t_ns):
    light, rate = np.zeros(SIZE[::-1], np.float32), np.zeros(SIZE[::-1], np.float32)
    video.light_and_rate(t_ns, light, rate)
    again = np.zeros_like(light)
    video.light(t_ns, again)
    np.testing.assert_array_equal(again, light)
    return light, rate


def test_light_goes_straight_in_log_between_frames(array):
    frames = np.full((3, 8, 12), 0.1, np.float32)
    frames[1], frames[2] = 0.4, 0.2
    video = Video(VideoParameters(array(frames), frames_per_s=10.0, floor=1e-6, light_at_white=2.0), SIZE)
    light, rate = drawn(video, 50_000_000)
    assert light[3, 3] == pytest.approx(2 * 0.2, rel=1e-4)
    assert rate[3, 3] == pytest.approx(light[3, 3] * math.log(4) / 0.1, rel=1e-4)
    assert drawn(video, 100_000_000)[0][0, 0] == pytest.approx(0.8, rel=1e-4)
    # the last frame stays for the mean time of one, then all begins anew
    assert drawn(video, 250_000_000)[1].max() == 0
    np.testing.assert_array_equal(drawn(video, 350_000_000)[0], light)


def test_without_a_loop_the_last_frame_stays(array):
    frames = np.stack([np.full((8, 12), v, np.float32) for v in (0.1, 0.3)])
    video = Video(VideoParameters(array(frames), loop=False, floor=1e-6, time_scale=100.0), SIZE)
    light, rate = drawn(video, 10**15)
    assert light[0, 0] == pytest.approx(0.3, rel=1e-4)
    assert rate.max() == 0


def test_frames_of_another_size_keep_their_mean_light(array):
    frames = np.random.default_rng(1).uniform(0.1, 1, (1, 19, 31)).astype(np.float32)
    light, _ = drawn(Video(VideoParameters(array(frames), floor=1e-6), SIZE), 0)
    assert light.mean() == pytest.approx(frames.mean(), rel=1e-4)
    halves = frames[0, :16, :24].reshape(8, 2, 12, 2).mean(axis=(1, 3))
    exact, _ = drawn(Video(VideoParameters(array(frames[:, :16, :24]), floor=1e-6), SIZE), 0)
    np.testing.assert_allclose(exact, halves, rtol=1e-4)


def test_srgb_is_decoded():
    levels = np.array([0, 10, 118, 255], np.uint8)
    np.testing.assert_allclose(
        linear_light(levels, 255.0, is_linear=False), [0, 0.00303527, 0.18116, 1], rtol=1e-4, atol=1e-7
    )


def test_a_folder_of_images_and_an_animation(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    images = [Image.fromarray(np.full((8, 12), v, np.uint8)) for v in (50, 100, 200)]
    for k, image in enumerate(images):
        image.save(folder / f"{k:03}.png")
    images[0].save(tmp_path / "a.gif", save_all=True, append_images=images[1:])
    for path in (folder, tmp_path / "a.gif"):
        frames = read_frames(path)
        assert frames.levels.shape == (3, 8, 12)
        assert list(frames.levels[:, 0, 0]) == [50, 100, 200]
    Image.fromarray(np.full((8, 12), 40000, np.uint16)).save(tmp_path / "deep.tif")
    assert read_frames(tmp_path / "deep.tif").levels.dtype == np.uint16
    assert Video(VideoParameters(str(folder)), SIZE).size == SIZE


def test_a_video_file(tmp_path):
    av = pytest.importorskip("av", reason="the `files` extra is not installed")
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=20)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuv420p"
        for level in (40, 120, 200):
            frame = av.VideoFrame.from_ndarray(np.full((16, 32), level, np.uint8), format="gray")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    frames = read_frames(path)
    assert frames.levels.shape == (3, 16, 32)
    np.testing.assert_allclose(frames.levels.mean(axis=(1, 2)), [40, 120, 200], atol=12)
    assert frames.times_s == pytest.approx([0, 0.05, 0.1])


def test_a_repeated_time_costs_its_frame_alone():
    pytest.importorskip("av", reason="the `files` extra is not installed")
    path = Path(__file__).parent / "onedup.mkv"
    frames = read_frames(path)
    assert len(frames.times_s) == len(frames.levels) == 49
    assert frames.times_s[-1] == pytest.approx(0.48)
    (note,) = frames.notes
    assert "1 of 50 frames are not later than the one before (1 at the same time; the first is frame 49" in note
    assert Video(VideoParameters(str(path), frames_per_s=60.0), SIZE).notes[:2] == (
        note,
        "frames_per_s = 60 is not used: the frames have times of their own",
    )


@pytest.mark.parametrize(
    ("times", "kept", "note"),
    [
        ([0, 1, 2, 1, 3], [0, 1, 2, 4], "1 earlier; the first is frame 3, at 0.01 s after 0.02 s"),
        ([0, 0, 1, 1, 2, 3, 2, 4], [0, 2, 4, 5, 7], "3 of 8 frames .*2 at the same time, 1 earlier"),
        ([5, 6, 8], [0, 1, 2], ""),
        ([0, 0], [0], "1 at the same time"),
    ],
)
def test_times_of_a_video_are_kept(monkeypatch, times, kept, note):
    """A stand-in for PyAV gives the times, because a muxer refuses those that go back."""
    seen = [
        SimpleNamespace(time=t / 100, to_ndarray=lambda format, k=k: np.full((2, 2), k, np.uint8))
        for k, t in enumerate(times)
    ]
    container = SimpleNamespace(decode=lambda video: seen)
    monkeypatch.setitem(sys.modules, "av", SimpleNamespace(open=lambda path: nullcontext(container)))
    values = read_video(Path("a.mkv"))
    assert values["levels"][:, 0, 0].tolist() == kept
    assert values["times_s"] == pytest.approx([(times[k] - times[0]) / 100 for k in kept])
    assert re.search(note, "".join(values["notes"]))
    assert bool(values["notes"]) == bool(note)


@pytest.mark.parametrize(
    ("times", "says"), [([3, 0, 1, 2], "3 of 4 frames are not later"), ([0, 0, 0], "2 at the same time")]
)
def test_a_video_of_which_most_frames_would_be_left_out_is_refused(monkeypatch, times, says):
    with pytest.raises(SceneError, match=says):
        test_times_of_a_video_are_kept(monkeypatch, times, [0], "")


def test_a_video_without_times_has_those_of_the_rig(monkeypatch):
    seen = [SimpleNamespace(time=None, to_ndarray=lambda format: np.zeros((2, 2), np.uint8))] * 3
    opened = nullcontext(SimpleNamespace(decode=lambda video: seen))
    monkeypatch.setitem(sys.modules, "av", SimpleNamespace(open=lambda path: opened))
    values = read_video(Path("a.mkv"))
    assert len(values["times_s"]) == 0
    assert values["notes"] == ["the file gives no times: frames_per_s holds"]


def folder_of(place, *names):
    """Write an image for each name, the k-th of level k."""
    place.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        Image.fromarray(np.full((2, 3), k, np.uint8)).save(place / name)
    return place


def test_images_of_a_folder_are_in_the_order_of_their_numbers(tmp_path):
    folder_of(tmp_path, "frame1.png", "frame2.png", "frame10.png", "frame010.tif", "frame11.png", "g3.png")
    (tmp_path / ".DS_Store").write_bytes(b"junk")
    (tmp_path / "._frame1.png").write_bytes(b"junk")
    (tmp_path / "notes.txt").write_text("junk")
    (tmp_path / "masks").mkdir()
    frames = read_frames(tmp_path)
    assert frames.levels[:, 0, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert frames.times_s is None
    assert frames.notes == ("2 files of the folder are no images and are left out: masks, notes.txt",)


NAMES = ("f1.png", "f2.png", "f10.png")


@pytest.mark.parametrize(
    ("name", "text", "order", "times_s", "unit"),
    [
        ("timestamps.txt", "0.5\n0.75\n1.5\n", [0, 1, 2], [0, 0.25, 1], "read as seconds$"),
        ("timestamps.txt", "# s\n0 f10.png\n.1 f1.png\n\n1e-1\tf2.png", [2, 0], [0, 0.1], "read as seconds$"),
        ("timestamps.txt", "f2.png 3\nf1.png 4\nf10.png 6", [1, 0, 2], [0, 1, 3], "read as seconds$"),
        ("images.csv", "time,file\n1000,f1.png\n34000000,f2.png\n", [0, 1], [0, 0.033999], "as nanoseconds, because"),
        (
            "images.csv",
            "1403636579763555584, f1.png\r\n1403636579813555456, f2.png\r\n",
            [0, 1],
            [0, 0.049999872],
            "nanos",
        ),
        ("timestamps.txt", "0\n33333\n66667", [0, 1, 2], [0, 0.033333, 0.066667], "as microseconds, because seconds"),
    ],
)
@pytest.mark.parametrize("place", ["", "images"])
def test_a_list_of_times_is_used(tmp_path, name, text, order, times_s, unit, place):
    """It lies in the folder, or beside a folder `images`, and the rig names either."""
    folder_of(tmp_path / place, *NAMES)
    (tmp_path / name).write_text(text.replace("f", "images/f") if place and "f" in text else text)
    for path in {tmp_path, tmp_path / place}:
        frames = read_frames(path)
        assert frames.levels[:, 0, 0].tolist() == order
        assert frames.times_s == pytest.approx(times_s, abs=1e-12)
        assert re.search(
            rf"the times of {text.count('.png') or 3} images are those of {name}, .*{unit}", frames.notes[0]
        )
        assert len(frames.notes) == 1 + (0 < text.count(".png") < 3) + ("1e-1" in text)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("0\n1\n", r"timestamps\.txt: has 2 times for 3 images"),
        ("", "has 0 times"),
        ("0\n1\nnan\n", "line 3: 'nan' is not a time"),
        ("0 1\n1 2\n2 3\n", "line 1: '0 1' is not a time"),
        ("0 gone.png\n1 f1.png\n2 f2.png\n", "line 1: there is no file 'gone.png'"),
        ("0 ../f1.png\n", "line 1: there is no file '../f1.png'"),
        ("0 f1.png\n1\n2 f2.png\n", "has 3 times for 2 images"),
        ("0\n1e99\n2\n", "its times span"),
        ("2\n1\n0\n", "2 of 3 frames are not later"),
    ],
)
def test_a_list_of_times_that_does_not_fit_is_refused(tmp_path, text, says):
    folder_of(tmp_path / "a", *NAMES)
    (tmp_path / "f1.png").write_bytes(b"")
    (tmp_path / "a" / "timestamps.txt").write_text(text)
    with pytest.raises(SceneError, match=says):
        read_frames(tmp_path / "a")


def test_what_eight_bits_cost_is_told(array):
    dark = np.full((2, 8, 12), 3, np.uint8)
    (note,) = Video(VideoParameters(array(dark), floor=1e-4), SIZE).notes
    assert "8-bit frames: below level" in note
    assert "100% of the first" in note
    assert Video(VideoParameters(array(np.full((2, 8, 12), 200, np.uint8))), SIZE).notes == ()
    assert Video(VideoParameters(array(dark.astype(np.float32))), SIZE).notes == ()
    deep = coarsest_level(65535.0, 1e-3, is_linear=False, threshold=0.2)
    assert deep == 0 < coarsest_level(255.0, 1e-3, is_linear=True, threshold=0.2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: (p / "a.png").write_bytes(b"junk"), r"a\.png: cannot be read as an image"),
        (lambda p: np.save(p / "a.npy", np.zeros((3, 3))), r"shape \(3, 3\)"),
        (lambda p: np.save(p / "a.npy", np.full((2, 3, 3), np.nan)), "frame 0 holds light that is negative or not"),
        (lambda p: np.save(p / "a.npy", np.zeros((2, 3, 3), np.int64)), "is int64"),
        (lambda p: (p / "a.npy").write_bytes(b"junk"), "cannot be read as an array"),
        (lambda p: (p / "a.mp4").write_bytes(b"junk" * 100), "frame 0 cannot be read"),
        (lambda p: None, "holds no frames"),
    ],
)
def test_broken_input_is_told(tmp_path, make, message):
    make(tmp_path)
    files = list(tmp_path.iterdir())
    with pytest.raises(SceneError, match=message):
        read_frames(files[0] if files else tmp_path)


def test_frames_must_be_alike(tmp_path):
    for k, width in enumerate((12, 13)):
        Image.fromarray(np.zeros((8, width), np.uint8)).save(tmp_path / f"{k}.png")
    with pytest.raises(SceneError, match=r"1\.png, frame 0 is 13 x 8 uint8, the first frame 12 x 8"):
        read_frames(tmp_path)


@pytest.mark.parametrize("bad", [{"frames_per_s": 0.0}, {"floor": 0.0}, {"light_at_white": math.nan}, {"path": ""}])
def test_nonsense_is_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        VideoParameters(**{"path": "a", **bad})
