"""Runs on a cluster of dask.distributed: the same table, and clear words where the cluster fails."""

import subprocess
import sys
from concurrent.futures import CancelledError
from types import SimpleNamespace

import pytest

from emulator.campaign.campaign import Campaign
from emulator.campaign.loading import load_source
from emulator.campaign.on_dask import DaskWorkers
from emulator.campaign.one_run import CampaignStopped, Place, run_row
from emulator.campaign.table import begin_folder, read_rows, rows_folder
from emulator.campaign.workers import run_campaign

pytestmark = pytest.mark.socket

CLUSTER = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.fixture
def cluster(tmp_path):
    """A cluster of two workers in processes of its own, as a user would have it: (process, address)."""
    (tmp_path / "cluster.py").write_text(CLUSTER)
    command = [sys.executable, str(tmp_path / "cluster.py")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.stdin.close()
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                process.kill()


def pure(row):
    return {name: value for name, value in row.items() if not name.startswith("machine.")}


@pytest.mark.long
@pytest.mark.system
def test_rows_are_those_of_local_runs(cluster, campaign_file, tmp_path):
    campaign, folder = Campaign(load_source(campaign_file(count=6))), tmp_path / "out"
    begin_folder(campaign, folder)
    came = []
    run_campaign(campaign, folder, range(6), DaskWorkers(campaign, folder, cluster[1]), came.append)
    assert len(came) == 6
    alone = [run_row(campaign, i, Place(tmp_path / "alone"), lambda _: None) for i in range(6)]
    assert [pure(row) for row in read_rows(rows_folder(folder))] == [pure(row) for row in alone]


@pytest.mark.long
@pytest.mark.system
def test_a_scheduler_that_vanishes_is_told_and_rows_stay(cluster, campaign_file, tmp_path):
    campaign, folder = Campaign(load_source(campaign_file(count=400))), tmp_path / "out"
    begin_folder(campaign, folder)
    workers = DaskWorkers(campaign, folder, cluster[1])
    came = []

    def vanish(row):
        came.append(row["index"])
        if len(came) == 3:
            cluster[0].kill()

    with pytest.raises(CampaignStopped, match="is gone, or has cancelled the runs"):  # it does not wait without end
        run_campaign(campaign, folder, range(400), workers, vanish)
    assert [row["index"] for row in read_rows(rows_folder(folder))] == sorted(came)
    assert 3 <= len(came) < 400


def test_no_scheduler(campaign, tmp_path, monkeypatch):
    monkeypatch.setattr("emulator.campaign.on_dask._CONNECT_S", 1)
    with pytest.raises(CampaignStopped, match=r"--scheduler: no scheduler answers at tcp://127\.0\.0\.1:9"):
        DaskWorkers(campaign(), tmp_path, "tcp://127.0.0.1:9")


@pytest.mark.parametrize("error", [ConnectionResetError("reset by peer"), CancelledError()])
def test_a_scheduler_that_vanishes_while_a_row_is_fetched_is_told(error, campaign, tmp_path, monkeypatch):
    def result():
        raise error

    monkeypatch.setattr("emulator.campaign.on_dask._connected", lambda _: None)
    workers = DaskWorkers(campaign(), tmp_path, "tcp://127.0.0.1:9")
    future = SimpleNamespace(key="k", status="finished", result=result)
    workers._futures["k"] = future
    with pytest.raises(CampaignStopped, match="is gone, or has cancelled the runs"):
        workers._row(future, 0)
