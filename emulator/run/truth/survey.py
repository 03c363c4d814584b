"""What a truth file holds, for `evstim info`: read by a child process with bounds on memory and time.

HDF5 answers a damaged file with whatever it runs into, so it is not opened in the process that asks.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

__all__ = ["is_hdf5", "main", "truth_in"]

_MAGIC = b"\x89HDF\r\n\x1a\n"
_MEMORY_BYTES, _CPU_S = 1 << 31, 120
_CHUNK = 1 << 20
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); from emulator.run.truth.survey import main; main()"
)


def is_hdf5(path: Path) -> bool:
    """Return whether a file begins as HDF5 does; False where it cannot be opened."""
    try:
        with path.open("rb") as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except OSError:
        return False


def truth_in(path: Path) -> dict[str, Any] | None:
    """Return what a truth file holds; None where it is none, or cannot be read."""
    if not path.is_file() or not is_hdf5(path):
        return None
    done = subprocess.run(
        [sys.executable, "-P", "-c", _START, str(path), json.dumps(sys.path)], capture_output=True, check=False
    )
    try:
        told: dict[str, Any] | None = json.loads(done.stdout)
    except ValueError:
        return None
    return told


def main() -> None:
    """Print as JSON what the file of the first argument holds; null where it is no truth file."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (_CPU_S, _CPU_S))
    sys.stdout.write(json.dumps(_survey(Path(sys.argv[1]))))


def _survey(path: Path) -> dict[str, Any] | None:
    import h5py

    from emulator.run.truth.layout import FORMAT

    try:
        file = h5py.File(path, "r")
    except OSError:  # its writer still has it, or was killed
        file = h5py.File(path, "r", swmr=True)
    with file:
        if file.attrs.get("format") != FORMAT:
            return None
        facts = {name: value.item() if hasattr(value, "item") else value for name, value in _plain(file.attrs).items()}
        counts = {group: len(file[f"{group}/t"]) if group in file else 0 for group in ("events", "clean_events")}
        return {
            **facts,
            **counts,
            "poses": len(file["poses/t"]) if "poses" in file else 0,
            "pictures": len(file["pictures/t"]),
            "of_each_picture": sorted(set(file["pictures"]) - {"t"}),
            "seconds": float(file["pictures/t"][-1]) * 1e-6 if len(file["pictures/t"]) else 0.0,
            "names": [name.decode() for name in file["labels/name"][:]],
            "origins": _counted(file["events/origin"]),
        }


def _plain(attributes: Any) -> dict[str, Any]:
    return {name: value for name, value in attributes.items() if getattr(value, "ndim", 0) == 0}


def _counted(codes: Any) -> dict[str, int]:
    """Return how many events each origin has, of those that it has any."""
    import h5py
    import numpy as np

    names = {code: name for name, code in h5py.check_enum_dtype(codes.dtype).items()}
    counts = np.zeros(256, np.int64)
    for start in range(0, len(codes), _CHUNK):
        counts += np.bincount(codes[start : start + _CHUNK], minlength=256)
    return {names.get(code, str(code)): int(counts[code]) for code in np.flatnonzero(counts)}


if __name__ == "__main__":
    main()
