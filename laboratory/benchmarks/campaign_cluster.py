"""The same campaign on a Dask cluster of this machine and by local workers.

    python -m laboratory.benchmarks.campaign_cluster 10000 3      # runs, workers of the cluster

A run is 20 ms of a checkerboard before 16 x 16 pixels, some ms of CPU time. Prints the CPU time of both campaigns, of
all processes, and ends with 1 unless both tables are equal row for row but for the columns machine.*.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import duckdb

CAMPAIGN = """
rig = "checkerboard"
count = {runs}
[set]
links = []
run = {{seconds = 0.02, pace = "free"}}
camera.sensor = {{width = 16, height = 16}}
[[parameters]]
key = "scene.speed_px_s"
kind = "log-uniform"
low = 30
high = 600
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
EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()", "campaign"]


@contextmanager
def cluster(folder, workers):
    """Yield the address of a cluster in processes of its own, as a user would have it."""
    (folder / "cluster.py").write_text(CLUSTER)
    command = [sys.executable, str(folder / "cluster.py"), str(workers)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
        yield process.stdout.readline().strip()
        process.stdin.close()


def children_s():
    """Return the CPU time of all processes that have ended and were waited for."""
    times = os.times()
    return times.children_user + times.children_system


def campaign(file, folder, *options):
    """Run a campaign into a folder."""
    begun_s = time.monotonic()
    subprocess.run([*EVSTIM, str(file), "--folder", str(folder), "--quiet", *options], check=True)
    print(f"{folder.name}: {time.monotonic() - begun_s:.0f} s wall", flush=True)


def differences(one, other):
    """Return rows and distinct runs of each table, and how many of its rows are not in the other."""
    pure = "select columns(lambda c: c not like 'machine.%') from '{}/rows.parquet'"
    tables = [pure.format(folder) for folder in (one, other)]
    counts = [duckdb.sql(f"select count(*), count(distinct index) from ({table})").fetchall()[0] for table in tables]
    a, b = tables
    lost = [duckdb.sql(f"select count(*) from ({x} except all {y})").fetchall()[0][0] for x, y in ((a, b), (b, a))]
    return counts, lost


def main(runs=10_000, workers=3):
    """Run both and compare."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "short.toml"
        file.write_text(CAMPAIGN.format(runs=runs))
        campaign(file, folder / "local", "--workers", "2")
        local_s = children_s()
        with cluster(folder, workers) as address:
            campaign(file, folder / "dask", "--scheduler", address)
        counts, lost = differences(folder / "local", folder / "dask")
        run_s = duckdb.sql(f"""select sum("machine.cpu_s") from '{folder}/local/rows.parquet'""").fetchall()[0][0]
    print(f"CPU: runs {run_s:.1f} s; local {local_s:.1f} s; cluster of {workers} {children_s() - local_s:.1f} s")
    print(f"rows and distinct runs: local {counts[0]}, cluster {counts[1]}; rows that differ: {sum(lost)}")
    sys.exit(counts != [(runs, runs)] * 2 or any(lost))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
