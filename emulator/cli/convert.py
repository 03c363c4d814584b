"""`evstim convert IN OUT` and `evstim recover IN OUT`."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from pathlib import Path

from emulator.cli.output import BAD_VERDICT, GOOD, WRONG_USE, Failure, Json, SensorSize, Topic, print_result, status
from emulator.cli.recordings import AS_IT_IS, Table, check_recording, parsed_size, reading, recording_of, writing
from firmware_protocol.recordings.part import Facts, counts_of, named
from transports.recording.event_files import recover_aedat4
from transports.recording.files import OpenRecording, RecordingFile
from transports.recording.format import Format
from transports.recording.part import Reader, RecordingError
from transports.recording.record import RawEvents

_PROGRESS_S = 2.0
_LATE = "as they come in the file after data of a later time"


def convert(
    source: Path,
    target: Path,
    /,
    *,
    to: str = "",
    size: SensorSize = None,
    topic: Topic = None,
    table: Table = AS_IT_IS,
    json: Json = False,
) -> int:
    """Convert a recording of events to another format, piece by piece: memory does not grow with the file.

    Parameters
    ----------
    source
        A recording in any format that can be read: see docs/recordings.md. Its first bytes determine the format.
    target
        The file to write; its suffix determines the format.
    to
        Name of the format, where the suffix does not determine it: aedat31, evt2, ros1-dvs, ...
    """
    _check_apart(source, target)
    with recording_of(source, size, table, topic) as recording:
        form = check_recording("OUT", target, to)
        return _convert(source, recording, recording.facts, target, form, json)


def _convert(path: Path, source: OpenRecording | Reader, facts: Facts, target: Path, form: Format, json: bool) -> int:
    """Write what a reader of the file `path` reads, print the result, and return the exit code."""
    start_s = time.monotonic()
    tally = Counter[str]()
    trouble = ""
    with writing(target):
        file = RecordingFile(target, form, facts, hold=bool(facts.streams & set(form.holds)))
    next_s = start_s + _PROGRESS_S
    try:
        for part in source.parts():
            tally.update(counts_of(part))
            with writing(target):
                file.write(part)
            if time.monotonic() > next_s:
                next_s += _PROGRESS_S
                status.print(f"{tally['events']:>14} events")
    except RecordingError as error:
        trouble = str(error)
    finally:
        with writing(target):
            file.close()
    seconds = time.monotonic() - start_s
    result = {
        "input": path, "output": file.paths, "format": form.name,
        **{name: file.written[name] for name in ("events", "edges", "imu", "frames")},
        "left_out": +(tally - file.written), "trouble": trouble, "seconds": seconds,
    }  # fmt: skip
    rate = file.written["events"] / max(seconds, 1e-9) * 1e-6
    lines = [f"{target}: {form.title}, {named(file.written) or 'nothing'}, {rate:.1f} Mev/s"]
    for reason, counts in ((f"as {form.title} cannot hold them", file.left_out), (_LATE, file.late)):
        if omitted := named(counts):
            lines.append(f"left out, {reason}: {omitted}")
    lines.append(f"opens in: {form.readers}")
    if trouble:
        lines.append(f"{path}: {trouble}; the part before it is in {target}")
    print_result(json, result, lines)
    return BAD_VERDICT if trouble else GOOD


def _check_apart(source: Path, target: Path) -> None:
    if source.exists() and target.exists() and source.samefile(target):
        raise Failure(f"{target}: is the input itself", WRONG_USE)


def recover(source: Path, target: Path, /, *, size: SensorSize = None, json: Json = False) -> int:
    """Save the readable part of a recording that was cut or never finished.

    Parameters
    ----------
    source
        An AEDAT 4.0 file, or the .part file of an .npz record. Other formats need no recovery: `evstim convert`
        converts everything before the damage.
    target
        The file to write: .aedat4 for AEDAT 4.0, any format for a .part file.
    """
    _check_apart(source, target)
    if source.suffix == ".part":
        if source.name.endswith(".edges.part"):
            raise Failure(f"{source}: holds edges; name the file of the events beside it", WRONG_USE)
        form = check_recording("OUT", target)
        with reading(source):
            source.stat()
            facts = Facts(parsed_size(size) or (1 << 16, 1 << 16), "record", streams=frozenset())
            return _convert(source, RawEvents(source, facts.size), facts, target, form, json)
    return _recover_aedat4(source, target, json)


def _recover_aedat4(source: Path, target: Path, json: bool) -> int:
    if check_recording("OUT", target).name != "aedat4":
        advice = "a file recovered from AEDAT 4.0 must end in .aedat4; `evstim convert` can convert it further"
        raise Failure(f"{target}: {advice}", WRONG_USE)
    with reading(source):
        if source.is_dir():
            raise RecordingError("is a folder")
        saved = recover_aedat4(source, target)
    left = f"{saved.left_bytes} bytes at the end are left out"
    line = f"{target}: {saved.packets} packets, {saved.kept_bytes} bytes; {left}"
    print_result(json, {"input": source, "output": target, **dataclasses.asdict(saved)}, [line])
    return GOOD if saved.packets else BAD_VERDICT
