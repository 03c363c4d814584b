"""Workers and the campaign itself are killed at random moments; and a disk that is full. As often as wanted:

    EVSTIM_CAMPAIGN_KILLS=200 python -m pytest tests/hostile/test_campaign_kills.py --timeout 0

A killed worker costs its own run, which is done again; a killed campaign goes on with the same command. In the end
every run has one row, the same as without kills.
"""

import os
import random
import signal
import subprocess
import sys
import time

import duckdb
import pytest

from emulator.campaign.campaign import Campaign
from emulator.campaign.loading import load_source
from emulator.campaign.one_run import Place, run_row
from emulator.campaign.table import done_rows

pytestmark = pytest.mark.system

KILLS = int(os.environ.get("EVSTIM_CAMPAIGN_KILLS", "6"))
CAMPAIGN = """
rig = "checkerboard"
count = {runs}
[set]
links = []
run = {{seconds = 0.1, pace = "free"}}
camera.sensor = {{width = 32, height = 32}}
[[parameters]]
key = "scene.speed_px_s"
kind = "log-uniform"
low = 30
high = 600
"""
_LEFT_ALONE = 0.9  # of the moments at which nothing has been done since the last kill
COMMAND = [sys.executable, "-c", "from emulator.cli import main; main()", "campaign"]


def workers(pid):
    """Return the worker processes of a campaign."""
    found = subprocess.run(["pgrep", "-P", str(pid), "-f", "emulator.campaign.worker"], capture_output=True, text=True)
    return [int(one) for one in found.stdout.split()]


def kill_now_and_then(file, kills, draw):
    """Run a campaign to its end over up to so many kills; return how many hit a worker, and the campaign."""
    killed = {"worker": 0, "campaign": 0}
    rows, seen = file.with_suffix("") / "rows", -1
    while True:
        with subprocess.Popen([*COMMAND, str(file), "--workers", "2"], stderr=subprocess.PIPE, text=True) as run:
            while run.poll() is None and sum(killed.values()) < kills:
                time.sleep(draw.uniform(0.05, 1.5))
                victims = workers(run.pid)
                if not victims or run.poll() is not None:
                    continue
                if len(done_rows(rows)) == seen and draw.random() < _LEFT_ALONE:
                    continue  # else a slow machine would never see a worker start
                seen = len(done_rows(rows))
                victim = run.pid if draw.random() < 0.2 else draw.choice(victims)
                os.kill(victim, signal.SIGKILL)
                killed["campaign" if victim == run.pid else "worker"] += 1
                if victim == run.pid:
                    break
            _, err = run.communicate(timeout=3600)
        assert "Traceback" not in err, err
        if run.returncode == -signal.SIGKILL or _kept_from_starting(run.returncode, err):
            continue
        assert run.returncode == 0, err
        return killed


def _kept_from_starting(code, err):
    """Whether a campaign gave up because each of its workers was killed before it had started."""
    return code == 3 and "worker processes do not start" in " ".join(err.split())


def check(file, sample):
    """Raise AssertionError unless every run has one row, those of `sample` as if nothing had been killed."""
    campaign, folder = Campaign(load_source(file)), file.with_suffix("")
    rows = f"'{folder}/rows.parquet'"
    counts = duckdb.sql(f"select count(*), count(distinct index), min(index), max(index) from {rows}").fetchall()
    assert counts == [(campaign.runs, campaign.runs, 0, campaign.runs - 1)], counts
    assert duckdb.sql(f"select distinct outcome from {rows}").fetchall() == [("ok",)]
    names = 'index, seed, "events.read_out", "events.digest", "scene.speed_px_s"'
    for index in sample:
        wanted = run_row(campaign, index, Place(folder), lambda _: None)
        (found,) = duckdb.sql(f"select {names} from {rows} where index = {index}").fetchall()
        assert found == tuple(wanted[name.strip('"')] for name in names.split(", ")), index


@pytest.mark.long
def test_killed_workers_and_campaigns_lose_and_double_no_run(tmp_path):
    file, draw = tmp_path / "kills.toml", random.Random(3)
    file.write_text(CAMPAIGN.format(runs=5 * KILLS))
    killed = kill_now_and_then(file, KILLS, draw)
    assert 0 < killed["worker"] + killed["campaign"] <= KILLS
    check(file, draw.sample(range(5 * KILLS), 20))


@pytest.mark.long
def test_a_full_disk_ends_the_campaign_and_what_was_written_stays(disk_of, tmp_path):
    tiny = disk_of("100k")
    file, folder = tmp_path / "c.toml", tiny / "c"
    file.write_text(CAMPAIGN.format(runs=40))
    command = [*COMMAND, str(file), "--workers", "1", "--folder", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    rows = duckdb.sql(f"select count(*), count(distinct index) from '{folder}/rows/*.parquet'").fetchall()[0]
    assert 0 < rows[0] < 40
    told = " ".join(done.stderr.split())
    assert "No space left on device: the row of run" in told
    assert f"{rows[0]} of 40 runs are done; the same command goes on" in told
    subprocess.run(["mount", "-o", "remount,size=4m", tiny], check=True)
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert duckdb.sql(f"select count(distinct index) from '{folder}/rows.parquet'").fetchall() == [(40,)]
