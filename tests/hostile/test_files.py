"""Damaged input files: each gives an error that begins with the file's name, or loads, within memory and time.

Thirty of each format by default; `EVSTIM_HOSTILE_FILES=10000` for the figures of docs/robustness.md, and
`EVSTIM_HOSTILE_SEED` for others. Libraries that read in a child process are forked here, with the same limits: a new
interpreter for each file would take most of the time. One file of each such format goes the whole way.
"""

import io
import os
import random
import resource
from dataclasses import dataclass

import faery
import numpy as np
import pytest
from PIL import Image, TiffImagePlugin

from emulator.light import SceneError
from emulator.playback.recording import load_recording
from emulator.rig.loading import RigError, load_rig, shipped_rigs
from emulator.scene.bodies.mesh import load_mesh
from emulator.scene.terrain.heightmap import load_heightmap
from emulator.scene.terrain.table import Heightmap
from emulator.scene.video.video import MOST_BYTES, Video, VideoParameters
from emulator.trajectory.building import read_path
from emulator.trajectory.parameters import FilePath
from emulator.trajectory.pose import TrajectoryError
from firmware_protocol.events import EVENT
from tests.forked_reader import Fork
from tests.hostile.mutation import damaged_archive, damaged_array, damaged_bytes, damaged_text
from tests.made_events import events_at
from tests.npz_records import save_record
from transports import guarded_reader

COUNT = int(os.environ.get("EVSTIM_HOSTILE_FILES", "30"))
SEED = int(os.environ.get("EVSTIM_HOSTILE_SEED", "1"))
MOST_S = 20.0  # processor time of one file; most take milliseconds
MOST_GROWTH_KIB = 500 << 10
SIZE = (346, 260)
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACETS = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def npy(array):
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def events(count=500):
    return events_at(np.arange(count) * 7, x=np.arange(count) % 346, y=5, on=np.arange(count) % 2)


def record(folder):
    save_record(folder / "a", events(), [0, 100])
    return (folder / "a").read_bytes()


def of_faery(suffix):
    def make(folder):
        path = folder / f"good{suffix}"
        faery.events_stream_from_array(events().astype(faery.EVENTS_DTYPE), SIZE).to_file(path)
        return path.read_bytes()

    return make


def shape(kind):
    def make(folder):
        import trimesh

        made = trimesh.Trimesh(CORNERS, FACETS, process=False).export(file_type=kind)
        return made.encode() if isinstance(made, str) else bytes(made)

    return make


def ascii_stl(folder):
    facet = "facet normal 0 0 1\nouter loop\n{}endloop\nendfacet\n"
    vertices = ("".join("vertex {} {} {}\n".format(*CORNERS[i]) for i in face) for face in FACETS)
    return f"solid a\n{''.join(facet.format(v) for v in vertices)}endsolid a\n".encode()


def table(folder):
    return "\n".join([*("v {} {} {}".format(*c) for c in CORNERS), *("f {} {} {}".format(*f) for f in FACETS)]).encode()


def counted(folder):
    rows = [*("{} {} {}".format(*c) for c in CORNERS), "4", *("{} {} {}".format(*f) for f in FACETS + 1)]
    return "\n".join(["4", *(f"{row}" for row in rows)]).encode()


def wavefront(folder):
    lines = ["# a shape", *("v {} {} {}".format(*c) for c in CORNERS), "vt 0 0"]
    return "\n".join([*lines, *("f {}/1 {}/1 {}//1".format(*f) for f in FACETS + 1)]).encode()


def image(kind, mode="L", count=1):
    def make(folder):
        frames = [Image.fromarray(np.full((8, 12), 50 + 30 * k, np.uint8)).convert(mode) for k in range(count)]
        out = io.BytesIO()
        frames[0].save(out, kind, save_all=count > 1, append_images=frames[1:])
        return out.getvalue()

    return make


def geotiff(folder):
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for number, kind, value in ((33550, 12, (5.0, 5.0, 0.0)), (33922, 12, (0.0,) * 3 + (-19e3, -4e3, 0.0))):
        tags[number], tags.tagtype[number] = value, kind
    tags[42113], tags.tagtype[42113] = "-32768", 2
    out = io.BytesIO()
    heights = np.random.default_rng(1).normal(0, 1, (20, 30)).astype(np.float32)
    Image.fromarray(heights).save(out, "TIFF", tiffinfo=tags)
    return out.getvalue()


def video(folder):
    import av

    path = folder / "good.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=20)
        stream.width, stream.height, stream.pix_fmt = 32, 16, "yuv420p"
        for level in (40, 120, 200):
            frame = av.VideoFrame.from_ndarray(np.full((16, 32), level, np.uint8), format="gray")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path.read_bytes()


TABLE = "t_s,x_m,y_m,z_m,qw,qx,qy,qz\n" + "".join(f"{k}.0,{k},0,-7000,1,0,0,0\n" for k in range(6))
OEM = """CCSDS_OEM_VERS = 2.0
CREATION_DATE = 2020-01-01T00:00:00
ORIGINATOR = TEST
META_START
OBJECT_NAME = A
CENTER_NAME = EROS
REF_FRAME = ICRF
TIME_SYSTEM = UTC
USEABLE_START_TIME = 2020-01-01T00:00:00
USEABLE_STOP_TIME = 2020-01-01T00:00:40
INTERPOLATION = HERMITE
INTERPOLATION_DEGREE = 3
META_STOP
""" + "".join(f"2020-01-01T00:00:{10 * k:02}.5 {100 + k} 2.0 3.0 0.1 0.0 0.0\n" for k in range(6))
AEM = """CCSDS_AEM_VERS = 1.0
META_START
OBJECT_NAME = A
REF_FRAME_A = ICRF
REF_FRAME_B = SC_BODY_1
ATTITUDE_DIR = A2B
TIME_SYSTEM = UTC
ATTITUDE_TYPE = QUATERNION
QUATERNION_TYPE = LAST
META_STOP
DATA_START
""" + "".join(f"2020-01-01T00:00:{10 * k:02}.5 0.0 0.0 0.0 1.0\n" for k in range(6)) + "DATA_STOP\n"  # fmt: skip
FLIGHT = "start 0 0 -700 0 10 0\n1 0 0 0 1 0\npause 2.5\nquaternion 1 2 3 1 0 0 0\nsun_position 1 2 3\n# end\n"


def text(content):
    return lambda folder: content.encode()


def rig(folder):
    return shipped_rigs()["rendezvous"].read_bytes()


def sound_path(path, attitudes=""):
    trajectory, (start, stop) = read_path(FilePath(path=str(path), attitude_path=str(attitudes), period_s=1.0))
    for t_ns in (start, (start + stop) // 2, stop):
        assert np.isfinite(trajectory.pose(t_ns).position_m).all()
    assert trajectory.bounds.speed_m_s >= 0
    assert trajectory.bounds.turn_rad_s >= 0


def with_places(path):
    places = path.with_suffix(".csv")
    places.write_text(TABLE)
    sound_path(places, path)


def sound_mesh(path):
    mesh = load_mesh(path, units_m=1.0)
    assert np.isfinite(mesh.normals).all()
    assert mesh.faces.max() < len(mesh.vertices)


def sound_map(path):
    ground = load_heightmap(Heightmap(path=str(path), post_m=1.0), 1_737_400.0)
    assert all(np.isfinite(heights).all() for heights in ground.heights_m)


def sound_video(path):
    with Video(VideoParameters(str(path)), (12, 8)) as scene:
        light, rate = np.zeros((2, 8, 12), np.float32)
        scene.light_and_rate(50_000_000, light, rate)
        assert np.isfinite(light).all()
        assert np.isfinite(rate).all()


def sound_recording(path):
    found = load_recording(path, SIZE)
    assert found.dtype == EVENT
    assert (np.diff(found["t"].astype(np.int64)) >= 0).all()


@dataclass(frozen=True)
class Format:
    name: str
    make: object
    damage: object
    load: object
    in_child: bool = False


LEVELS = np.arange(2 * 8 * 12, dtype=np.uint8).reshape(2, 8, 12)
HEIGHTS = np.random.default_rng(2).normal(0, 0.3, (9, 12))
FORMATS = [
    Format("rig.toml", rig, damaged_text, lambda path: load_rig(str(path))),
    Format("tagged.tab", table, damaged_text, sound_mesh),
    Format("counted.tab", counted, damaged_text, sound_mesh),
    Format("shape.obj", wavefront, damaged_text, sound_mesh),
    Format("map.npy", lambda folder: npy(HEIGHTS), damaged_array, sound_map),
    Format("levels.npy", lambda folder: npy(LEVELS), damaged_array, sound_video),
    Format("floats.npy", lambda folder: npy(LEVELS / np.float32(255)), damaged_array, sound_video),
    Format("record.npz", record, damaged_archive, sound_recording),
    Format("path.csv", text(TABLE), damaged_text, sound_path),
    Format("path.oem", text(OEM), damaged_text, sound_path),
    Format("path.fli", text(FLIGHT), damaged_text, sound_path),
    Format("attitudes.aem", text(AEM), damaged_text, with_places),
    Format("binary.stl", shape("stl"), damaged_bytes, sound_mesh, in_child=True),
    Format("text.stl", ascii_stl, damaged_text, sound_mesh, in_child=True),
    Format("binary.ply", shape("ply"), damaged_bytes, sound_mesh, in_child=True),
    Format("shape.off", shape("off"), damaged_text, sound_mesh, in_child=True),
    Format("shape.glb", shape("glb"), damaged_bytes, sound_mesh, in_child=True),
    Format("map.tif", geotiff, damaged_bytes, sound_map, in_child=True),
    Format("image.png", image("PNG"), damaged_bytes, sound_video, in_child=True),
    Format("image.jpg", image("JPEG"), damaged_bytes, sound_video, in_child=True),
    Format("images.gif", image("GIF", "P", 3), damaged_bytes, sound_video, in_child=True),
    Format("video.mp4", video, damaged_bytes, sound_video, in_child=True),
    Format("events.aedat4", of_faery(".aedat4"), damaged_bytes, sound_recording, in_child=True),
    Format("events.es", of_faery(".es"), damaged_bytes, sound_recording, in_child=True),
    Format("events.dat", of_faery(".dat"), damaged_bytes, sound_recording, in_child=True),
    Format("events.raw", of_faery(".raw"), damaged_bytes, sound_recording, in_child=True),
    Format("events.csv", of_faery(".csv"), damaged_text, sound_recording, in_child=True),
]


def spent_s():
    return sum(os.times()[:4])


def refusal(one, path, n):
    """Return the message with which a file is refused; None where it loads."""
    try:
        one.load(path)
    except (RigError, SceneError, TrajectoryError) as error:
        return str(error)
    except BaseException as error:
        error.add_note(f"mutation {n}")
        raise
    return None


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("one", FORMATS, ids=lambda one: one.name)
def test_a_damaged_file_is_refused_by_name_or_read(one, tmp_path, monkeypatch):
    if one.in_child:
        monkeypatch.setattr(guarded_reader, "_start", Fork)
    good, path = one.make(tmp_path), tmp_path / one.name
    path.write_bytes(good)
    one.load(path)
    refused, before_kib = 0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for n in range(COUNT):
        data = one.damage(good, random.Random(f"{SEED} {one.name} {n}"))
        path.write_bytes(data)
        start_s = spent_s()
        message = refusal(one, path, n)
        if message is not None:
            assert message.startswith(f"{path}"), (n, message)
            assert len(message) < 2000, (n, message)
            refused += 1
        assert spent_s() - start_s < MOST_S, n
    # A damaged size may still be a video's: then it loads, and its frames have the bound that the scene states.
    frames_kib = MOST_BYTES >> 10 if one.load is sound_video else 0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib < MOST_GROWTH_KIB + frames_kib
    assert refused > COUNT // 10
