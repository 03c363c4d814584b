"""Descents over the Moon in the layout of ELOPE, their score, and a baseline of optical flow and range finder.

    python elope.py make FOLDER --count 28       # our own descents, over three kinds of terrain; minutes each
    python elope.py solve FOLDER velocities.json # the baseline; --tick-us 1000: with event times of whole milliseconds
    python elope.py score FOLDER velocities.json # of the baseline, or of a program of yours
    python elope.py table FOLDER ...             # the baseline's scores by terrain, of one folder or more

ELOPE is ESA's Event-based Lunar OPtical flow Egomotion challenge of 2025. A sequence is a file 0000.npz, 0001.npz, ...:

    events        (n,) structured: x, y (0 to 199), p (bool, True: brighter), t (us)
    timestamps    (120,) s
    traj          (120, 12) at these times: x y z, m; vx vy vz, m/s; phi theta psi, rad; p q r, rad/s. NaN: not given
    range_meter   (m, 2): time, s, and distance along pixel (100, 100), m; 10 a second

Axes here are x east, y north, z up; R = Rz(psi) Ry(theta) Rx(phi) turns the body, which looks along its -z, into them,
and p q r are about the body's axes. Those of the published files are not described where we could read it.

The score of a sequence is the mean over its times of |v estimated - v true| / z true. Answers are a JSON with lists vx,
vy and vz by the sequence's number. A file or an answer that cannot be used is named, and the program ends with 2.

Events of the published files have times of whole milliseconds; ours have the sensor's.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import zipfile
import zlib
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

import evstim

sys.path.insert(0, str(Path(__file__).parents[1] / "landing"))
from divergence import Lens, Motion, Window, estimate

SIZE = 200, 200
LENS = Lens(100 / math.tan(math.radians(30)), SIZE)
TIMES, PERIOD_S = 120, 0.1  # of the range finder and of the given poses
TERRAINS = {"plain": (0.5, 0.01), "craters": (2.0, 0.046), "hills": (8.0, 0.046)}  # slope in degrees, craters
EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "?"), ("t", "<i8")])
TRAVEL_PX, LONGEST_S, LEAST_EVENTS = 8.0, 3.0, 1000  # of a window of the baseline


class Sequence(NamedTuple):
    """One descent; the arrays of its file."""

    events: np.ndarray
    timestamps: np.ndarray
    traj: np.ndarray
    range_meter: np.ndarray

    @classmethod
    def load(cls, file: Path) -> Sequence:
        """Read a sequence; raises ValueError for a file with another layout."""
        try:
            with file.open("rb") as opened, np.load(opened) as arrays:
                if missing := [name for name in cls._fields if name not in arrays]:
                    raise ValueError(f"{', '.join(missing)} missing")
                sequence = cls(*(arrays[name] for name in cls._fields))
            sequence.check()
        except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{file}: {error}: it is no sequence of ELOPE") from error
        return sequence

    def check(self) -> None:
        """Raise ValueError for arrays of another layout, or times and ranges that are no finite numbers."""
        count = len(np.atleast_1d(self.timestamps))
        shapes = {"timestamps": (count,), "traj": (count, 12), "range_meter": (len(np.atleast_1d(self.range_meter)), 2)}
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.dtype.kind not in "iuf" or array.shape != shape or not count:
                raise ValueError(f"{name} has shape {array.shape} of {array.dtype}, not {shape} of numbers")
        for name in ("timestamps", "range_meter"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} has values that are no finite numbers")
        if self.events.ndim != 1 or self.events.dtype.names is None or not {*"xypt"} <= {*self.events.dtype.names}:
            raise ValueError(f"events are {self.events.dtype}, not x, y, p and t")

    def motion(self) -> np.ndarray:
        """Return true heights and velocities, (120, 4); raises ValueError where they are not given."""
        motion = self.traj[:, 2:6]
        if not np.isfinite(motion).all() or not (motion[:, 0] > 0).all():
            raise ValueError("its traj lacks velocities, or heights above 0: there is no score without them")
        return motion


class Velocities(msgspec.Struct, forbid_unknown_fields=True):
    """Answer to one sequence, m/s at its timestamps."""

    vx: list[float]
    vy: list[float]
    vz: list[float]


@dataclasses.dataclass(frozen=True)
class Descent:
    """A descent at rates that fall with the height: z = z0 e^(-k t), and so its speed along the ground.

    Attributes
    ----------
    seed : of the descent; it determines the rest, and terrain and Sun.
    without : "noise" of the sensor, "relief" of the ground, which then differs in brightness alone; "": with both.
    """

    seed: int
    without: str = ""

    @property
    def terrain(self) -> str:
        """Name of the terrain."""
        return list(TERRAINS)[self.seed % len(TERRAINS)]

    @property
    def _drawn(self) -> tuple[float, ...]:
        """Height and its end, m; duration, s; course, rad; slope of the path; Sun; amplitude of the tilt; its rate."""
        low = np.array([2000.0, 130.0, 40.0, 0.0, 0.1, 10.0, 0.01, 0.1])
        high = np.array([3000.0, 170.0, 55.0, 2 * math.pi, 0.6, 45.0, 0.05, 0.3])
        return tuple(np.random.default_rng([5, self.seed]).uniform(low, high).tolist())

    @property
    def seconds(self) -> float:
        """Length of the descent."""
        return self._drawn[2]

    def at(self, t_s: float) -> np.ndarray:
        """Return the row of `traj` at a time, (12,)."""
        height, end, seconds, course, along, _, tilt, rate = self._drawn
        fall = math.log(height / end) / seconds
        z = height * math.exp(-fall * t_s)
        east, north = math.cos(course) * along, math.sin(course) * along
        angles = [tilt * math.sin(rate * t_s), tilt * math.sin(rate * t_s + 2), rate * 0.1 * t_s]
        speeds = [tilt * rate * math.cos(rate * t_s), tilt * rate * math.cos(rate * t_s + 2), rate * 0.1]
        phi, theta, _ = angles
        turning = [
            speeds[0] - speeds[2] * math.sin(theta),
            speeds[1] * math.cos(phi) + speeds[2] * math.cos(theta) * math.sin(phi),
            speeds[2] * math.cos(theta) * math.cos(phi) - speeds[1] * math.sin(phi),
        ]
        place, velocity = [-east * z, -north * z, z], [east * fall * z, north * fall * z, -fall * z]
        return np.array(place + velocity + angles + turning)

    def rig(self) -> evstim.Rig:
        """Return the rig, with the terrain and the Sun of this descent."""
        rig = evstim.load_rig(Path(__file__).with_name("descent.toml"))
        sensor = rig.camera.sensor
        if self.without == "noise":
            sensor = dataclasses.replace(sensor, noise=dataclasses.replace(sensor.noise, rms=0.0))
        slope_deg, craters = TERRAINS[self.terrain]
        relief = {"slope_deg": slope_deg, "crater_density": craters}
        if self.without == "relief":
            relief = {"slope_deg": 0.0, "crater_density": 0.0, "boulder_cover": 0.0, "albedo_rms": 0.2}
        ground = dataclasses.replace(rig.scene.ground, seed=self.seed // len(TERRAINS) + 1, **relief)
        start = camera_pose(self.at(0.0))
        camera = dataclasses.replace(
            rig.scene.camera,
            position_m=tuple(start.position_m.tolist()),
            q_world_from_body=tuple(start.q_world_from_body.tolist()),
        )
        scene = dataclasses.replace(rig.scene, ground=ground, camera=camera, sun_elevation_deg=self._drawn[5])
        return dataclasses.replace(rig, scene=scene, camera=dataclasses.replace(rig.camera, sensor=sensor))


def body_attitude(angles: np.ndarray) -> np.ndarray:
    """Return the quaternion world from body of phi, theta, psi, scalar first, (4,)."""
    (a, b, c), (d, e, f) = np.cos(angles / 2), np.sin(angles / 2)
    return np.array([
        a * b * c + d * e * f, d * b * c - a * e * f, a * e * c + d * b * f, a * b * f - d * e * c
    ])  # fmt: skip


def camera_pose(row: np.ndarray) -> evstim.Pose:
    """Return the pose of the camera, which looks along the body's -z with its y to the body's -y."""
    w, x, y, z = body_attitude(row[6:9])
    return evstim.Pose(row[:3].copy(), np.array([-x, w, z, -y]))  # times (0, 1, 0, 0)


def fly(descent: Descent) -> Sequence:
    """Return a descent and its events."""
    steps = math.floor(descent.seconds / PERIOD_S)
    pieces, ranges = [], []
    with evstim.Simulation(descent.rig(), seed=descent.seed) as sim:
        for k in range(1, steps + 1):
            t_s = k * PERIOD_S
            now = sim.step(round(PERIOD_S * 1e6), camera=camera_pose(descent.at(t_s)), truth=True)
            pieces.append(now.events)
            ranges.append((t_s, float(now.truth.depth[100, 100])))
    events = np.concatenate(pieces)
    out = np.empty(len(events), EVENT)
    out["x"], out["y"], out["p"] = events["x"], events["y"], events["on"]
    out["t"] = events["t"]
    timestamps = np.linspace(0, steps * PERIOD_S, TIMES)
    return Sequence(out, timestamps, np.stack([descent.at(t) for t in timestamps]), np.array(ranges))


class Unsolvable(ValueError):
    """The baseline lacks something in a sequence."""


def solve(sequence: Sequence, tick_us: int = 1) -> np.ndarray:
    """Return velocities at the timestamps, (120, 3), from events, attitudes and ranges; raises Unsolvable."""
    if not np.isfinite(sequence.traj[:, 6:9]).all():
        raise Unsolvable("its attitudes are not given, which the baseline needs")
    events = np.empty(len(sequence.events), [("t", "u8"), ("x", "u2"), ("y", "u2"), ("on", "?")])
    for name, field in (("t", "t"), ("x", "x"), ("y", "y"), ("on", "p")):
        events[name] = sequence.events[field]
    events["t"] -= events["t"] % np.uint64(tick_us)
    times, ranges = sequence.timestamps, sequence.range_meter
    attitudes = [(t, body_attitude(row[6:9])) for t, row in zip(times.tolist(), sequence.traj, strict=True)]
    upright = np.array([1 - 2 * (q[1] ** 2 + q[2] ** 2) for _, q in attitudes])  # cosine of the tilt
    heights = np.interp(times, *ranges.T) * upright
    reach_px = SIZE[0] / 2 + 20, SIZE[1] / 2 + 20
    seen: list[tuple[float, np.ndarray]] = []
    aside = np.zeros(2)
    for t_s in times.tolist():
        # The range finder gives a first divergence; without it a wrong motion would be the guess of the next window.
        around_s = np.clip([t_s - 1, t_s + 1], times[0], times[-1])
        down = -np.diff(np.log(np.interp(around_s, times, heights)))[0] / np.diff(around_s)[0]
        guess = Motion(*aside, down, 1.0, 0.0, 0)
        moves = max(abs(guess.down), math.hypot(guess.east, guess.south), 0.01)
        half_s = min(TRAVEL_PX / (moves * 100), LONGEST_S) / 2
        since_s, until_s = max(t_s - half_s, 0.0), min(t_s + half_s, float(times[-1]))
        first, last = np.searchsorted(events["t"], [int(since_s * 1e6), int(until_s * 1e6)])
        window = Window(LENS, 1)
        window.add_events(events[first:last])
        rays = window.rays(since_s, until_s, attitudes)
        if len(rays.t_s) < LEAST_EVENTS:
            continue
        found = estimate(rays, guess, 0.01 + 0.5 * abs(guess.down), LENS.focal_px, reach_px)
        agrees = abs(found.down - guess.down) < 0.5 * abs(guess.down)
        aside = np.array([found.east, found.south]) if found.reliable and agrees else 0.5 * aside
        if found.reliable and agrees:
            height = float(np.interp(found.at_s, times, heights))
            seen.append((found.at_s, np.array([found.east, -found.south, -found.down]) * height))
    if not seen:
        return np.zeros((TIMES, 3))
    at_s, velocities = np.array([t for t, _ in seen]), np.array([v for _, v in seen])
    return np.stack([np.interp(times, at_s, column) for column in velocities.T], axis=1)


def score(sequence: Sequence, velocities: np.ndarray) -> float:
    """Return the score of velocities, (120, 3); less is better.

    Raises ValueError for another shape, for values that are not finite, and where the true motion is not given.
    """
    count, truth = len(sequence.timestamps), sequence.motion()
    if velocities.shape != (count, 3) or not np.isfinite(velocities).all():
        wrong = np.argwhere(~np.isfinite(velocities)) if velocities.shape == (count, 3) else []
        at = "".join(f"; v{'xyz'[column]}[{row}] is {velocities[row, column]}" for row, column in wrong[:1])
        raise ValueError(f"velocities: {count} finite numbers of each are needed{at}")
    with np.errstate(over="ignore"):
        errors = np.linalg.norm(velocities - truth[:, 1:], axis=1) / truth[:, 0]
    if not np.isfinite(mean := float(errors.mean())):
        raise ValueError(f"its score is {mean}: velocities that large cannot be compared")
    return mean


def _sequences(folder: Path) -> dict[int, Path]:
    """Return the files of a folder by their numbers."""
    files = {int(file.stem): file for file in sorted(folder.glob("*.npz")) if file.stem.isdigit()}
    if not files:
        raise ValueError(f"{folder}: no file 0000.npz or the like: `elope.py make {folder}` makes some")
    return files


def make(folder: Path, count: int, without: str) -> None:
    """Write descents into a folder; those that are there already stay."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(count):
        file, part = folder / f"{seed:04d}.npz", folder / "part.npz"
        if not file.exists():
            sequence = fly(Descent(seed, without))
            np.savez_compressed(part, **sequence._asdict())
            part.replace(file)
            seconds = sequence.timestamps[-1]
            print(f"{file}: {len(sequence.events)} events in {seconds:.1f} s, {Descent(seed).terrain}", flush=True)


def answer(folder: Path, answers: Path, tick_us: int) -> None:
    """Write the baseline's velocities of all sequences of a folder."""
    found = {}
    for number, file in _sequences(folder).items():
        try:
            velocities = solve(Sequence.load(file), tick_us)
        except Unsolvable as error:
            raise ValueError(f"{file}: {error}") from error
        found[str(number)] = dict(zip(("vx", "vy", "vz"), velocities.T.tolist(), strict=True))
        print(f"{file}: solved", flush=True)
    answers.write_text(json.dumps(found))


def scores_of(folder: Path, answers: Path) -> dict[int, float]:
    """Return and print the scores of answers by the sequence's number."""
    files, scores = _sequences(folder), {}
    if not answers.is_file():
        raise ValueError(f"{answers}: no such file: `elope.py solve {folder} {answers}` makes one of the baseline")
    try:
        velocities = msgspec.convert(json.loads(answers.read_bytes()), dict[str, Velocities])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{answers}: {error}: expected lists vx, vy and vz by the sequence's number") from error
    if missing := [str(number) for number in files if str(number) not in velocities]:
        raise ValueError(f"{answers}: no answer to sequence {', '.join(missing[:5])}")
    if extra := [name for name in velocities if name not in map(str, files)]:
        raise ValueError(f"{answers}: there is no sequence {', '.join(extra[:5])} in {folder}")
    for number, file in files.items():
        sequence, answer = Sequence.load(file), velocities[str(number)]
        if len({len(sequence.timestamps), len(answer.vx), len(answer.vy), len(answer.vz)}) > 1:
            raise ValueError(
                f"{answers}: sequence {number}: {len(sequence.timestamps)} finite numbers of each are needed"
            )
        try:
            scores[number] = score(sequence, np.array([answer.vx, answer.vy, answer.vz]).T)
        except ValueError as error:
            raise ValueError(f"{answers}: sequence {number}: {error}") from error
    for number in scores:
        print(f"sequence {number}: {scores[number]:.4f}")
    print(f"mean of {len(scores)} sequence{'s' * (len(scores) != 1)}: {np.mean(list(scores.values())):.4f}")
    return scores


def table(folders: list[Path]) -> None:
    """Print the baseline's mean scores by terrain, in per cent, with the times as they are and in milliseconds."""
    for file in (file for folder in folders for file in _sequences(folder).values()):
        sequence = Sequence.load(file)
        try:
            sequence.motion()
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from error
    print(f"| descents | times | {' | '.join(TERRAINS)} | all |\n|---|---|{'---|' * (len(TERRAINS) + 1)}")
    for folder in folders:
        sequences = {number: Sequence.load(file) for number, file in _sequences(folder).items()}
        for tick_us, name in ((1, "1 us"), (1000, "1 ms")):
            scores = {number: 100 * score(one, solve(one, tick_us)) for number, one in sequences.items()}
            kinds = [
                [value for number, value in scores.items() if Descent(number).terrain == kind] for kind in TERRAINS
            ]
            cells = [f"{np.mean(values):.2f}" if values else "-" for values in [*kinds, list(scores.values())]]
            print(f"| {folder.name} | {name} | {' | '.join(cells)} |", flush=True)


def main(*words: str) -> None:
    """Run a command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("make", "solve", "score"):
        command = commands.add_parser(name)
        command.add_argument("folder", type=Path)
        if name == "make":
            command.add_argument("--count", type=int, default=28)
            command.add_argument("--without", choices=["noise", "relief"], default="")
        else:
            command.add_argument("answers", type=Path)
        if name == "solve":
            command.add_argument("--tick-us", type=int, default=1, help="of the times of the events")
    commands.add_parser("table").add_argument("folders", type=Path, nargs="+")
    arguments = parser.parse_args(words)
    if min(getattr(arguments, "count", 1), getattr(arguments, "tick_us", 1)) < 1:
        parser.error("--count and --tick-us must be 1 or more")
    try:
        if arguments.command == "make":
            make(arguments.folder, arguments.count, arguments.without)
        elif arguments.command == "solve":
            answer(arguments.folder, arguments.answers, arguments.tick_us)
        elif arguments.command == "score":
            scores_of(arguments.folder, arguments.answers)
        else:
            table(arguments.folders)
    except (ValueError, OSError) as error:
        parser.exit(2, f"elope.py: {error}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
