"""Cost of `evstim campaign` beside its runs, and the same campaign by local workers and on a Dask cluster.

python -m laboratory.benchmarks.campaign overhead [RUNS] [MS] [WORKERS]
python -m laboratory.benchmarks.campaign cluster [RUNS] [WORKERS_OF_THE_CLUSTER]
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import App

from emulator.campaign.report import numbers
from emulator.campaign.table import read_rows
from laboratory.benchmarks.streams import children_s

app = App(name="campaign")

EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()", "--quiet", "campaign"]
OVERHEAD = """
rig = "checkerboard"
count = {runs}
[set]
links = []
run = {{seconds = {seconds}, pace = "free"}}
camera.sensor = {{width = {side_px}, height = {side_px}}}
[[parameters]]
key = "scene.speed_px_s"
kind = "log-uniform"
low = 30
high = 600
"""


def cost(runs: int, seconds: float, workers: int) -> tuple[float, float, float]:
    """Return the CPU time of a campaign, that of its runs, and its wall time; s."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "overhead.toml")
        file.write_text(OVERHEAD.format(runs=runs, seconds=seconds, side_px=32))
        begun_s = time.monotonic()
        process = subprocess.Popen([*EVSTIM, str(file), "--workers", str(workers)], stdout=subprocess.DEVNULL)
        _, code, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(code)
        assert process.returncode == 0, "the campaign did not end well, see above"
        wall_s = time.monotonic() - begun_s
        rows = read_rows(file.with_suffix("") / "rows")
    return used.ru_utime + used.ru_stime, float(np.sum(numbers(rows, "machine.cpu_s"))), wall_s


@app.command
def overhead(runs: int = 1000, ms: int = 100, workers: int = 2) -> None:
    """Measure the cost of `evstim campaign` beside its runs of MS of stream time and 32 x 32 pixels.

    CPU time of all processes of the command, start and report included, less that of the runs (`machine.cpu_s` of each
    row), over the latter: a busy machine does not change it much. A second campaign of as many runs as workers gives
    what is paid once.
    """
    whole_s, runs_s, wall_s = cost(runs, ms * 1e-3, workers)
    once_s, few_s, _ = cost(workers, ms * 1e-3, workers)
    print(f"{runs} runs of {1000 * runs_s / runs:.1f} ms CPU, {workers} workers, load {os.getloadavg()[0]:.0f}")
    print(f"CPU time: {whole_s:.1f} s, of the runs {runs_s:.1f} s: {(whole_s - runs_s) / runs_s:.1%} more")
    each_ms = 1000 * (whole_s - runs_s - once_s + few_s) / (runs - workers)
    print(f"paid once: {once_s - few_s:.1f} s; for each run: {each_ms:.2f} ms; wall {wall_s:.0f} s")


SHORT = f"""{OVERHEAD}
[[parameters]]
key = "camera.sensor.threshold_on"
kind = "uniform"
low = 0.1
high = 0.5
"""
CLUSTER = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    n = int(sys.argv[1])
    with LocalCluster(n_workers=n, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[str]:
    """Yield the address of a cluster in processes of its own, as a user would have it."""
    (folder / "cluster.py").write_text(CLUSTER)
    command = [sys.executable, str(folder / "cluster.py"), str(workers)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
        yield process.stdout.readline().strip()
        process.stdin.close()


def campaign(file: Path, folder: Path, *options: str) -> None:
    """Run a campaign into a folder."""
    begun_s = time.monotonic()
    subprocess.run([*EVSTIM, str(file), "--folder", str(folder), *options], check=True)
    print(f"{folder.name}: {time.monotonic() - begun_s:.0f} s wall", flush=True)


def differences(duckdb: Any, folders: tuple[Path, Path]) -> tuple[list[tuple[int, int]], list[int]]:
    """Return rows and distinct runs of each folder's table, and how many of its rows are not in the other."""
    pure = "select columns(lambda c: c not like 'machine.%') from '{}/rows.parquet'"
    tables = [pure.format(folder) for folder in folders]
    counts = [duckdb.sql(f"select count(*), count(distinct index) from ({table})").fetchall()[0] for table in tables]
    a, b = tables
    lost = [duckdb.sql(f"select count(*) from ({x} except all {y})").fetchall()[0][0] for x, y in ((a, b), (b, a))]
    return counts, lost


@app.command(name="cluster")
def on_cluster(runs: int = 10_000, workers: int = 3) -> None:
    """Run the same campaign by local workers and on a Dask cluster of this machine, and compare.

    A run is 20 ms of a checkerboard before 16 x 16 pixels, some ms of CPU time. Prints the CPU time of both campaigns,
    of all processes, and ends with 1 unless both tables are equal row for row but for the columns machine.*.
    """
    import duckdb

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "short.toml"
        file.write_text(SHORT.format(runs=runs, seconds=0.02, side_px=16))
        campaign(file, folder / "local", "--workers", "2")
        local_s = children_s()
        with cluster(folder, workers) as address:
            campaign(file, folder / "dask", "--scheduler", address)
        counts, lost = differences(duckdb, (folder / "local", folder / "dask"))
        run_s = duckdb.sql(f"""select sum("machine.cpu_s") from '{folder}/local/rows.parquet'""").fetchall()[0][0]
    print(f"CPU: runs {run_s:.1f} s; local {local_s:.1f} s; cluster of {workers} {children_s() - local_s:.1f} s")
    print(f"rows and distinct runs: local {counts[0]}, cluster {counts[1]}; rows that differ: {sum(lost)}")
    sys.exit(counts != [(runs, runs)] * 2 or any(lost))


if __name__ == "__main__":
    app()
