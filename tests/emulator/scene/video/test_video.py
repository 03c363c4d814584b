"""Videos: straight lines in log light between frames, every depth, and what is broken is told."""

import math

import numpy as np
import pytest
from PIL import Image

from emulator.light import SceneError
from emulator.scene.video.video import Video, VideoParameters, coarsest_level, linear_light, read_frames

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


def test_a_truncated_image_is_told(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (80, 80), np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(SceneError, match="cannot be read as an image"):
        read_frames(path)


@pytest.mark.parametrize("bad", [{"frames_per_s": 0.0}, {"floor": 0.0}, {"light_at_white": math.nan}, {"path": ""}])
def test_nonsense_is_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        VideoParameters(**{"path": "a", **bad})
