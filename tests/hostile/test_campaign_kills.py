"""Some kills of a campaign and its workers; `campaign_kills.py` does as many as wanted. And a disk that is full."""

import subprocess

import duckdb
import pytest

from tests.hostile.campaign_kills import CAMPAIGN, COMMAND, kill_campaign

pytestmark = pytest.mark.system


@pytest.mark.long
def test_killed_workers_and_campaigns_lose_and_double_no_run(tmp_path):
    killed = kill_campaign(tmp_path, runs=30, kills=6, seed=3)
    assert killed["worker"] + killed["campaign"] > 0


@pytest.fixture
def tiny(tmp_path):
    """A disk of 100 KiB; only root can make one."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=100k", "none", folder], capture_output=True, check=False)
    if made.returncode:
        pytest.skip(f"this user cannot mount a tmpfs: {made.stderr.decode().strip()}")
    yield folder
    subprocess.run(["umount", folder], check=True)


@pytest.mark.long
def test_a_full_disk_ends_the_campaign_and_what_was_written_stays(tiny, tmp_path):
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
