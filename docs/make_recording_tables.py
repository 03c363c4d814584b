"""Write the tables of real recordings that `evstim validate` compares with.

    python docs/make_recording_tables.py STREET.aedat4 EVK4.raw

STREET is tests/data/test_data.aedat4 of the source distribution of the Python package aedat 2.3.0; EVK4 is
tests/data/evt3.raw of that of faery 0.7.1. See laboratory/validation/data/SOURCES.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from emulator.playback.recording import read_events, read_frames
from laboratory.characterise.recordings import still_pixels
from laboratory.characterise.still_light import still_light
from laboratory.validation.recordings import DATA, QUIET_HZ, QUIET_TILES, kick_lags, quiet_tiles, sequences


def street(path: Path) -> None:
    """Write the light and the events of the still half of the DAVIS346's recording, and the kicks of all pixels."""
    events, _ = read_events(path)
    begin_us = int(events["t"][0])
    seen = still_light(read_frames(path), begin_us)
    if seen is None:
        raise SystemExit(f"{path}: has too few frames")
    seconds = float(events["t"][-1] - begin_us) * 1e-6
    events["t"] -= begin_us
    chosen = events[seen.still[events["y"], events["x"]]]
    np.savez_compressed(
        DATA / "davis346_street.npz",
        level=np.round(seen.level * 16).astype(np.uint16),
        still=np.packbits(seen.still),
        frames=np.array([seen.first_us, seen.interval_us, seen.exposure_us]),
        seconds=seconds,
        t=chosen["t"].astype(np.uint32),
        x=chosen["x"],
        y=chosen["y"],
        on=chosen["on"],
        lags=np.histogram(kick_lags(events[~seen.still[events["y"], events["x"]]], seen), np.arange(-2000, 4001))[0],
    )


def evk4(path: Path) -> None:
    """Write the statistics of the quiet pixels of the EVK4's recording, of its halves and of its quiet tiles."""
    events, size = read_events(path)
    if size is None:
        raise SystemExit(f"{path}: has no size")
    seconds = float(events["t"][-1] - events["t"][0]) * 1e-6
    quiet = still_pixels(events, size, seconds, QUIET_HZ)
    begin_us = events["t"][0]
    events = events[quiet[events["y"], events["x"]]]
    events["t"] -= begin_us
    tables = {}
    for pixels in QUIET_TILES:
        of_tiles = quiet_tiles(events, quiet, pixels, seconds)
        columns = [of_tiles.rows, of_tiles.columns, of_tiles.values]
        tables[f"tiles_{pixels}"] = np.column_stack(columns).astype(np.float32)
    for half, side in (("left", slice(0, size[0] // 2)), ("right", slice(size[0] // 2, size[0]))):
        columns = np.arange(size[0])[side]
        part = events[np.isin(events["x"], columns)]
        found = sequences(part, size[0], int(quiet[:, side].sum()))
        tables |= {f"{name}_{half}": values for name, values in found.items()}
    np.savez_compressed(DATA / "evk4_quiet.npz", seconds=seconds, **tables)


if __name__ == "__main__":
    street(Path(sys.argv[1]))
    evk4(Path(sys.argv[2]))
