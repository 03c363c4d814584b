"""Data sets: sequences of events with their truth, each a run of a campaign.

    DIR/dataset.toml              the campaign: `evstim campaign again DIR/dataset.toml 17 --folder DIR`
       /sequences/000017.h5       a truth file, see `emulator.run.truth.file`; .npz: the same arrays by the same names;
                 /000017/         without a suffix: a folder as the DSEC data set has it, with truth.h5, the truth file
       /manifest.json             seed, parameters, digests and file of each sequence
       /README.md                 a data card, made of the manifest

A sequence is a function of the campaign's content and its index. Its file appears whole, under its name, or not at all;
the row of its run is written after it.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, overload

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from emulator.campaign.campaign import Campaign, Row
from emulator.campaign.loading import (
    FLOW_HZ,
    CampaignError,
    SequenceTruth,
    Source,
    campaign_text,
    laid_over,
    leaves,
    located,
    parse_laws,
    table_of,
)
from emulator.report.pictures import deep_png
from emulator.rig.loading import Rig, find_rig, parse_rig, read_rig
from emulator.run.assembly import build_scene, build_session, schedule
from emulator.run.truth.source import RunTruth, TruthArrays, TruthFile, TruthRefused
from emulator.tables.toml_text import KeyPath, dotted, toml_of
from emulator.tables.typed_table import TableError
from firmware_protocol.events import Events, Float32s, Floats, Int64s, Kept, Mask, UInt16s, make_events
from transports.link.pacing import MonotonicClock
from transports.recording.format import FORMATS

_COUNT = 100
_REFUSED = {
    "the data set itself gives it, see the options of `evstim dataset`": re.compile(
        r"rig|count|seed|record|program|truth|set\.run(\.(seconds|pace))?"
    ),
    "it has no effect: a data set has no links, clocks and verdicts": re.compile(
        r"title|success|min_success|report"
        r"|set\.(links|faults|trigger|second_camera|verdict)\b.*"
        r"|set\.run\.(lockstep_us|lead_us|max_late_ms|max_late_share|restart_links|fifo_priority)"
        r"|set\.camera\.(serial|speed|layout|fifo_bytes|start_delay_ms|activity_filter)"
        r"|set\.camera\.(clock|imu|frames|bias_slopes)\b.*"
    ),
}
_REFINEMENTS = 4  # of the place at the end of a step; each leaves the error times half a step and the flow's gradient


@dataclass(frozen=True)
class Sequences:
    """Number, length and content of the sequences of a data set.

    Attributes
    ----------
    count : number of points, each a sequence, or `repeats` of them; None: 100, and those of a grid.
    seconds : length of each, of stream time.
    seed : of everything random.
    vary : further keys of a campaign file, such as `parameters`, `sampling` and `set`; or a TOML file that has them.
    """

    count: int | None
    seconds: float
    truth: SequenceTruth
    seed: int = 1
    vary: Mapping[str, Any] | str | Path | None = None


def dataset_source(rig: str | Path, file: Path, sequences: Sequences) -> Source:
    """Return the campaign of a data set of a rig, to be written as `file`; raises CampaignError and RigError."""
    rig_file = find_rig(str(rig)).absolute()
    rig_text = read_rig(rig_file)
    parsed = parse_rig(rig_text, str(rig_file), rig_file.stem)
    if parsed.trigger is not None or parsed.second_camera is not None:
        raise CampaignError(f"{rig_file}: a data set has one camera and no link: remove [trigger] and [second_camera]")
    vary, truth = sequences.vary, sequences.truth
    author = "vary", ""
    if isinstance(vary, str | Path):
        author = str(vary), campaign_text(Path(vary))
        vary = table_of(author[1], author[0])
    table = dict(vary or {})
    try:
        _check_varied(table)
    except TableError as error:
        raise located(Source(*author, "", ""), error) from error
    run = {"seconds": sequences.seconds, "pace": "free", "step_us": _step_us(parsed.run.step_us, truth.rate_hz)}
    settings = laid_over({"links": [], "faults": [], "run": run}, table.get("set", {}))
    named = str(rig_file if Path(rig).is_file() else rig)
    content = {"rig": named, "truth": dataclasses.asdict(truth), "set": settings}
    count = _COUNT if sequences.count is None and table.get("sampling") != "grid" else sequences.count
    table = {"seed": sequences.seed} | table | ({} if count is None else {"count": count}) | content
    return Source(str(file), toml_of(table), str(rig_file), rig_text, *author)


def _check_varied(table: Mapping[str, Any]) -> None:
    """Raise TableError for a key of `vary` that a data set gives itself, or that has no effect on it."""
    if not isinstance(table.get("set", {}), dict):
        raise TableError(f"expected a table, got {table['set']!r}", ("set",))
    keys: list[tuple[str, KeyPath]] = [(key, (key,)) for key in table]
    keys += [(dotted(path), path) for path in leaves({"set": table.get("set", {})})]
    for i, law in enumerate(parse_laws(table.get("parameters", []))):
        keys += [(f"set.{key}", ("parameters", i, "key")) for key in (law.key, *law.also)]
    for key, path in keys:
        for reason, refused in _REFUSED.items():
            if refused.fullmatch(key):
                named = f"{key.removeprefix('set.')}: " if path[0] == "parameters" else ""
                raise TableError(f"{named}{reason}; remove it", path)


def _step_us(step_us: int, rate_hz: float) -> int:
    """Return the longest step up to `step_us` that divides the time between two truths, or at least is no longer."""
    period_us = round(1e6 / rate_hz)
    if abs(period_us * rate_hz - 1e6) > 1e-3:
        return min(step_us, int(1e6 / rate_hz))
    return next(step for step in range(min(step_us, period_us), 0, -1) if period_us % step == 0)


def sequence_path(folder: Path, index: int, truth: SequenceTruth) -> Path:
    """Return the file or the folder of a sequence."""
    return folder / "sequences" / (f"{index:06d}" if truth.format == "dsec" else f"{index:06d}.{truth.format}")


@contextmanager
def written_sequence(rig: Rig, truth: SequenceTruth, path: Path) -> Iterator[RunTruth]:
    """Give the truth of a run, and put it in place as `path` where the block ends without an error.

    Raises OSError where there is no room, and TruthRefused.
    """
    path.parent.mkdir(exist_ok=True)
    for left in path.parent.glob(f".{path.stem}.*"):  # of a killed run, whose writer may still have it
        _remove(left)
    part = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    file = part / "truth.h5" if truth.format == "dsec" else part
    recorded = TruthArrays(rig, truth.selection) if truth.format == "npz" else TruthFile(rig, file, truth.selection)
    try:
        file.parent.mkdir(exist_ok=True)
        with recorded:
            yield recorded
        if recorded.trouble:
            raise OSError(errno.EIO, recorded.trouble, str(path))
        if isinstance(recorded, TruthArrays):
            with part.open("wb") as opened:
                np.savez_compressed(opened, **recorded.arrays())  # type: ignore[arg-type]
        if truth.format == "dsec":
            write_dsec(part, round(truth.rate_hz / FLOW_HZ))
            _remove(path)  # a folder, unlike a file, does not replace another one
        part.replace(path)
    finally:
        _remove(part)


def _remove(path: Path) -> None:
    """Remove a file or a folder, where there is one."""
    with suppress(OSError):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def write_dsec(folder: Path, pictures: int) -> None:
    """Write the files of a sequence of DSEC beside `folder`/truth.h5: its events, and flow between so many pictures.

    Files and their numbers: dsec.ifi.uzh.ch, "Data format". Raises OSError.
    """
    import h5py

    left, forward = folder / "events/left", folder / "flow/forward"
    left.mkdir(parents=True)
    (folder / "images").mkdir()
    events = FORMATS["dsec"].open_reader(folder / "truth.h5")
    with closing(FORMATS["dsec"].open_writer(left / "events.h5", events.facts)) as file:
        for part in events.parts():
            file.write(part)
    with h5py.File(folder / "truth.h5") as truth, h5py.File(left / "rectify_map.h5", "w") as rectified:
        t_us, layers = np.rint(truth["pictures/t"][:]).astype(int), truth["pictures"]
        pixels = np.indices((truth.attrs["height"], truth.attrs["width"]), np.float32)
        rectified["rectify_map"] = np.moveaxis(pixels, 0, -1)[..., ::-1]
        np.savetxt(folder / "images/timestamps.txt", t_us, "%d")
        if not {"flow", "labels"} <= {*layers}:
            return
        forward.mkdir(parents=True)
        firsts = range(0, len(t_us) - pictures, pictures)
        for k in firsts:
            seen = slice(k, k + pictures + 1)
            moved, is_known = displacement(t_us[seen], layers["flow"][seen], layers["labels"][seen])
            coded = np.rint(moved * 128) + 2**15
            is_known &= ((coded >= 0) & (coded < 2**16)).all(axis=-1)
            coded[~is_known] = 2**15
            (forward / f"{k:06d}.png").write_bytes(deep_png(np.dstack([coded, is_known]).astype(np.uint16)))
        pairs = np.array([(t_us[k], t_us[k + pictures]) for k in firsts], int).reshape(-1, 2)
        names = "from_timestamp_us, to_timestamp_us"
        np.savetxt(folder / "flow/forward_timestamps.txt", pairs, "%d", ", ", header=names)


def displacement(t_us: Int64s, flow: Float32s, labels: UInt16s) -> tuple[Floats, Mask]:
    """Return how far the point at each pixel's middle moves from the first instant to the last, and where it is known.

    From one instant to the next by the trapezoidal rule along the path of the point. It is unknown where the path
    leaves the picture, or a pixel around its end has another label.

    Parameters
    ----------
    t_us : (n,) instants.
    flow, labels : (n, height, width, 2) px/s, and (n, height, width).

    Returns
    -------
    (height, width, 2) px to the right and down, and (height, width).
    """
    at = begin = np.indices(labels.shape[1:]).astype(np.float64)  # rows, columns
    is_known = np.ones(labels.shape[1:], bool)
    for k, half_s in enumerate(np.diff(t_us) * 0.5e-6):
        before = end = _flow_at(flow[k], at)
        for _ in range(_REFINEMENTS):
            end = _flow_at(flow[k + 1], at + half_s * (before + end))
        at = at + half_s * (before + end)
        for label in np.unique(labels[0]):
            is_near = map_coordinates((labels[k + 1] == label).astype(np.float64), at, order=1) > 1 - 1e-9
            is_known &= is_near | (labels[0] != label)
    return np.moveaxis(at - begin, 0, -1)[..., ::-1], is_known


def _flow_at(flow: Float32s, at: Floats) -> Floats:
    """Return the flow between pixels, rows and columns a second, at rows and columns (2, height, width)."""
    return np.stack([map_coordinates(flow[..., axis], at, np.float64, order=1, mode="nearest") for axis in (1, 0)])


def check_layers(truth: SequenceTruth, recorded: RunTruth) -> None:
    """Raise TruthRefused for layers that were named and that the scene does not have."""
    if missing := [layer for layer in truth.layers if layer not in recorded.about.layers]:
        reason = recorded.about.facts["absent"] or "it has no surfaces"
        raise TruthRefused(f"truth.layers: this scene has no {', '.join(missing)} ({reason})")


@dataclass(frozen=True, eq=False, repr=False)
class TruthSequence(Kept):
    """A sequence of a data set.

    Attributes
    ----------
    index, seed : of its run.
    values : of the parameters, by key.
    arrays : data sets of a truth file by their names, such as "pictures/depth".
    names : of the labels from 1 on.
    digest : of the arrays.
    """

    index: int
    seed: int
    values: Mapping[str, Any]
    arrays: Mapping[str, npt.NDArray[Any]]
    names: tuple[str, ...]
    digest: str

    @property
    def events(self) -> Events:
        """The events, (n,) EVENT, as the sensor reads them out."""
        t, x, y, p = (self.arrays.get(f"events/{name}", np.zeros(0, np.uint64)) for name in "txyp")
        return make_events(t, x, y, p > 0)


class Dataset(Sequence[TruthSequence]):
    """A data set whose sequences are made when they are read: `data[3]` is the same on any machine, each time.

    It is what torch's DataLoader takes for a map-style data set.
    """

    def __init__(self, source: Source) -> None:
        self._campaign = Campaign(source)

    def __len__(self) -> int:
        return self._campaign.runs

    @overload
    def __getitem__(self, index: int) -> TruthSequence: ...
    @overload
    def __getitem__(self, index: slice) -> list[TruthSequence]: ...
    def __getitem__(self, index: int | slice) -> TruthSequence | list[TruthSequence]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"sequence {index} of {len(self)}")
        return self._made(index % len(self))

    def _made(self, index: int) -> TruthSequence:
        campaign, truth = self._campaign, self._campaign.settings.truth
        assert truth is not None, "the campaign of a data set has a truth"
        rig = campaign.rig(index)
        with build_scene(rig) as scene, TruthArrays(rig, truth.selection) as recorded:
            session = build_session(rig, scene, [], MonotonicClock(), recorded)
            check_layers(truth, recorded)
            session.run(schedule(rig))
        names = tuple(recorded.about.names)
        return TruthSequence(
            index, campaign.seed(index), campaign.values(index), recorded.arrays(), names, recorded.digest
        )


def dataset(  # noqa: PLR0913 - one call that names all it needs
    rig: str | Path,
    count: int | None,
    *,
    seconds: float = 1.0,
    truth: Sequence[str] = (),
    rate_hz: float = 20.0,
    vary: Mapping[str, Any] | str | Path | None = None,
    seed: int = 1,
) -> Dataset:
    """Return a data set of a rig: sequences of events with their truth, made when they are read.

    Parameters
    ----------
    rig : name of a shipped rig, or path of a rig file.
    count : number of points, each a sequence, or `repeats` of them; None for a grid, which has its own.
    seconds : length of each, of stream time.
    truth : of "light", "depth", "flow", "labels", "poses" and "clean_events"; by default depth, flow, labels and poses,
        as far as the scene has them.
    rate_hz : light, depth, flow and labels a second.
    vary : sampled parameters, as keys of a campaign file: {"parameters": [{"key": ..., "kind": "uniform", ...}]}, or a
        TOML file with them. Without any, sequences differ by their seeds.
    seed : of everything random.

    Raises CampaignError or RigError where the rig or a parameter cannot be used, ValueError where a layer or a rate.
    """
    sequences = Sequences(count, seconds, SequenceTruth(rate_hz, tuple(truth)), seed, vary)
    return Dataset(dataset_source(rig, Path("dataset.toml").absolute(), sequences))


def write_manifest(campaign: Campaign, folder: Path, rows: Sequence[Row]) -> dict[str, Any]:
    """Write the manifest and the data card of the sequences that are done, and return the manifest; raises OSError."""
    truth = campaign.settings.truth
    assert truth is not None, "the campaign of a data set has a truth"
    sequences = [
        {
            "file": str(sequence_path(folder, row["index"], truth).relative_to(folder)),
            "index": row["index"],
            "seed": row["seed"],
            "values": campaign.values(row["index"]),
            "seconds": row["sim_s"],
            "events": row["events.read_out"],
            "events_digest": row["events.digest"],
            "truth_digest": row["truth.digest"],
        }
        for row in rows
        if row["outcome"] == "ok"
    ]
    manifest = {
        "format": "evstim-dataset",
        "version": 1,
        "evstim": version("evstim"),
        "id": campaign.id,
        "rig": Path(campaign.source.rig_file).stem,
        **campaign.content,
        "sequences": sequences,
    }
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=1, default=str) + "\n")
    (folder / "README.md").write_text(_card(campaign, sequences, truth))
    return manifest


def _card(campaign: Campaign, sequences: Sequence[Mapping[str, Any]], truth: SequenceTruth) -> str:
    """Return the data card: content, origin and limits of the data."""
    rig = campaign.rig(0)
    width, height = rig.camera.size
    events = sum(sequence["events"] for sequence in sequences)
    seconds = sum(sequence["seconds"] for sequence in sequences)
    layers = ", ".join(truth.layers) or "depth, flow, labels and poses, as far as the scene has them"
    laws = "".join(
        f"| `{table['key']}` | {', '.join(f'{name} {value}' for name, value in table.items() if name != 'key')} |\n"
        for table in campaign.content["campaign"].get("parameters", [])
    )
    return f"""# {rig.title or rig.name}

Simulated events with truth, made by evstim {version("evstim")}. No real camera was used.

- sequences: {len(sequences)} of {campaign.runs}, together {seconds:.6g} s; events: {events}
- camera `{rig.camera.model}`, {width} x {height} pixels; rig `{rig.name}`
- truth: {layers}; {truth.rate_hz:g} times a second; the cause of each event
- layout: pages *Data sets* and *Recordings and truth* of evstim's documentation
- times of events are whole microseconds of stream time, without errors of a camera's clock or link
- `manifest.json`: seed, parameters and digests of each sequence, which are the same on any machine
- `evstim campaign again dataset.toml INDEX --folder .` makes a sequence again and compares it

| sampled | law |
|---|---|
| seed | each sequence its own |
{laws}
How close the simulated camera is to a real one: page *What it is worth* of that documentation. Licences of the rig's
shape models and images hold for what is drawn of them.
"""
