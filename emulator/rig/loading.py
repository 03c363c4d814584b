"""Rig files: the set-up of a run as TOML, with units in the keys; typed and frozen once loaded.

    title = "a title of the rig"
    [scene]
    kind = "checkerboard"      # "bodies", "terrain", ...: each kind has its own keys
    [camera]
    model = "davis346"
    [[links]]                  # any number of them
    kind = "usbip"

`emulator.rig.top_level` has the top-level keys. Each key below them is a field of a dataclass, in `emulator.rig.tables`
or in the package that owns the table. A mistake raises RigError with the file, the line, the key, the error and the
allowed values. A command or a call may replace some values of the `[run]` table. `second_rig` is the rig as its second
camera has it: its model, its links, and the scene from where it is mounted.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from emulator.rig.kinds import CAMERA_MODELS
from emulator.rig.tables import Camera, Run, SecondCamera, Trigger, Verdict
from emulator.rig.top_level import values_of
from emulator.scene.kind import SceneParameters
from emulator.tables.toml_text import TextFileError, TomlError, read_text, read_toml
from emulator.tables.typed_table import TableError, beside, convert
from firmware_protocol.bounds import Bounded, unshared
from transports.faults.kinds import Fault
from transports.link.kind import LinkParameters
from transports.registry import unknown

_MOST_BYTES = 1 << 22  # the longest shipped rig has 4 KiB


class RigError(Exception):
    """A rig file cannot be used; the message is for its author."""


@dataclass(frozen=True)
class RigSource:
    """The file from which a rig was loaded.

    Attributes
    ----------
    path : as it was found.
    text : its content.
    options : values of the `[run]` table that a command replaced, by key.
    """

    path: str
    text: str
    options: Mapping[str, object] = field(default_factory=dict)

    @property
    def sha256(self) -> str:
        """SHA-256 digest of the file, hexadecimal, as `sha256sum` prints it."""
        return hashlib.sha256(self.text.encode()).hexdigest()


@dataclass(frozen=True)
class Rig(Bounded):
    """One bench set-up; `source` is its file, None for a rig that a program made."""

    name: str
    title: str
    scene: SceneParameters
    camera: Camera = field(default_factory=Camera)
    run: Run = field(default_factory=Run)
    links: tuple[LinkParameters, ...] = ()
    trigger: Trigger | None = None
    faults: tuple[Fault, ...] = ()
    verdict: Verdict = field(default_factory=Verdict)
    second_camera: SecondCamera | None = None
    source: RigSource | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.run.quality >= 0:
            from emulator.rig.quality import check_rung  # which few rigs need

            check_rung(self)


def shipped_rigs() -> dict[str, Path]:
    """Return the rigs that come with evstim, by name."""
    root = Path(__file__).parents[2]
    installed = root / "evstim" / "rigs"
    folder = installed if installed.is_dir() else root / "rigs"  # the second in a checkout
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def find_rig(rig: str) -> Path:
    """Return the file of a rig given by path or by the name of a shipped one; raises RigError."""
    path = Path(rig)
    if path.suffix == ".toml" or path.exists():
        if path.is_file():
            return path
        if path.is_dir():
            raise RigError(f"{rig}: is a folder; give the path of a .toml file in it, or the name of a shipped rig")
        raise RigError(f"{rig}: no such file")
    shipped = shipped_rigs()
    if rig in shipped:
        return shipped[rig]
    raise RigError(f"{unknown(rig, list(shipped))}; or give the path of a .toml file")


def load_rig(rig: str) -> Rig:
    """Load a rig by path or name; raises RigError."""
    path = find_rig(rig)
    text = read_rig(path)
    return dataclasses.replace(parse_rig(text, str(path), path.stem), source=RigSource(str(path), text))


def read_rig(path: Path) -> str:
    """Return the text of a rig file; raises RigError."""
    try:
        return read_text(path, _MOST_BYTES)
    except TextFileError as error:
        raise RigError(f"{path}: {error}") from error


def rig_of_table(table: dict[str, Any], name: str, folder: Path) -> Rig:
    """Make a rig of the tables of a rig file that lies in `folder`; raises TableError."""
    run = table.get("run")
    if isinstance(run, dict) and "quality" in run:
        from emulator.rig.quality import with_rung

        table = dict(with_rung(table))
    values = values_of(table)
    title = name if values["title"] is None else values["title"]
    try:
        return beside(Rig(name, **{**values, "title": title}), folder)
    except ValueError as error:  # of its rung
        raise TableError(str(error), ("run", "quality")) from error


def parse_rig(text: str, file: str, name: str) -> Rig:
    """Make a rig of TOML text; `file` is for messages. Raises RigError."""
    try:
        return rig_of_table(read_toml(text), name, Path(file).parent)
    except TomlError as error:
        raise RigError(error.at(file)) from error
    except TableError as error:
        raise RigError(error.at(file, text)) from error


def with_options(rig: Rig, seconds: float | None = None, seed: int | None = None, pace: str | None = None) -> Rig:
    """Return the rig with the values that are not None; raises ValueError, its message begins with the name."""
    options = {"seconds": seconds, "seed": seed, "pace": pace}
    changed = unshared({name: value for name, value in options.items() if value is not None})
    try:
        run = convert({**vars(rig.run), **changed}, Run)
    except TableError as error:
        name = str(error.path[-1])
        raise ValueError(str(error) if str(error).startswith(name) else f"{name} {error}") from error
    source = rig.source
    if source is not None:
        source = dataclasses.replace(source, options={**source.options, **changed})
    if run.pace == "free" and not run.seconds and getattr(rig.scene, "loop", False):
        raise ValueError(
            'seconds must be above 0 here, got 0: with pace "free" a recording or video that loops '
            "(scene.loop) never ends"
        )
    return dataclasses.replace(rig, run=run, source=source)


def carries_second(rig: Rig, link: str) -> bool:
    """Return whether a link carries the rig's second camera."""
    return rig.second_camera is not None and link in rig.second_camera.links


def second_rig(rig: Rig) -> Rig:
    """Return the rig as its second camera has it; raises RigError where its scene has no path to mount it on."""
    second = rig.second_camera
    assert second is not None
    camera = _second_model(rig.camera, second)
    if rig.run.quality >= 0:  # both are on one rung
        noise = dataclasses.replace(camera.sensor.noise, grade=rig.camera.sensor.noise.grade)
        camera = dataclasses.replace(camera, sensor=dataclasses.replace(camera.sensor, noise=noise))
    return dataclasses.replace(
        rig,
        camera=camera,
        links=tuple(link for link in rig.links if carries_second(rig, link.name)),
        run=dataclasses.replace(rig.run, seed=rig.run.seed + 1),
        scene=_moved(rig, second),
        trigger=None,
        second_camera=None,
    )


def _second_model(first: Camera, second: SecondCamera) -> Camera:
    """Return the first camera with another serial number, or one of another model with the same lens and connector."""
    if second.model in ("", first.model):
        return dataclasses.replace(first, serial=second.serial)
    return dataclasses.replace(
        first,
        model=second.model,
        serial=second.serial,
        sensor=CAMERA_MODELS[second.model].sensor,
        imu=None,
        frames=None,
        bias_slopes=None,
        activity_filter=False,
    )


def _moved(rig: Rig, second: SecondCamera) -> SceneParameters:
    from emulator.trajectory.building import MountedPath
    from emulator.trajectory.parameters import BasiliskPath, LivePath

    path = getattr(rig.scene, "camera", None)
    if path is None or isinstance(path, LivePath | BasiliskPath):
        raise RigError(
            f"{rig.name}: second_camera: this scene's camera has no path of its own on which another can be mounted; "
            "take one of bodies, terrain or stars with a path that the rig gives"
        )
    moved = MountedPath(path, second.offset_m, second.q_first_from_second)
    return dataclasses.replace(rig.scene, camera=moved)
