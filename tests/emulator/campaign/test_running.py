"""Campaigns run by workers: rows are those of single runs, and what kills a worker costs its own run alone."""

import json
import os
import subprocess
import sys
import time

import pytest

from emulator.campaign.campaign import Campaign
from emulator.campaign.loading import load_source
from emulator.campaign.one_run import CampaignStopped, Place, run_row
from emulator.campaign.table import begin_folder, read_rows, rows_folder
from emulator.campaign.workers import LocalWorkers, WarmWorker, part_of, remaining, run_campaign
from tests.emulator.campaign.processes import gone

pytestmark = pytest.mark.system


def run_all(file, folder, indices=None, workers=1):
    campaign = Campaign(load_source(file))
    begin_folder(campaign, folder)
    local = LocalWorkers([WarmWorker(campaign, folder, threads=1) for _ in range(workers)])
    run_campaign(campaign, folder, range(campaign.runs) if indices is None else indices, local, lambda _: None)
    return read_rows(rows_folder(folder))


def pure(row):
    return {name: value for name, value in row.items() if not name.startswith("machine.")}


def program(script, tmp_path, *arguments, table=""):
    (tmp_path / "program.py").write_text(script)
    argv = ["{python}", "program.py", *arguments]
    return f"[program]\nargv = {json.dumps(argv)}\n{table}\n"


def test_rows_of_workers_are_those_of_single_runs(campaign_file, tmp_path):
    file, folder = campaign_file(count=5, top='success = ["events.read_out > 20"]'), tmp_path / "out"
    rows = run_all(file, folder, workers=2)
    campaign = Campaign(load_source(file))
    alone = [run_row(campaign, i, Place(tmp_path / "alone"), lambda _: None) for i in (4, 3, 2, 1, 0)][::-1]
    assert [pure(row) for row in rows] == [pure(row) for row in alone]
    assert [row["index"] for row in rows] == list(range(5))
    assert len({row["events.digest"] for row in rows}) == 5
    assert all(row["outcome"] == "ok" and row["events.read_out"] > 0 for row in rows)
    assert remaining(folder, range(8)) == [5, 6, 7]
    assert not (folder / "runs").exists()


KILLER = """
import os, pathlib, sys
tries = pathlib.Path(sys.argv[1])
before = tries.read_text() if tries.exists() else ""
tries.write_text(before + "x")
if len(before) < int(sys.argv[2]):
    os.kill(os.getppid(), 9)
"""


@pytest.mark.long
def test_a_run_whose_worker_is_killed_is_done_again(campaign_file, tmp_path):
    more = program(KILLER, tmp_path, "tries{index}", "{program.kills}")
    more += '[[parameters]]\nkey = "program.kills"\nkind = "list"\nvalues = [0, 1, 3]\n'
    file = campaign_file(top='sampling = "grid"', more=more)
    text = file.read_text().replace("count = 4\n", "").replace("high = 0.5", "high = 0.5\nsteps = 1")
    file.write_text(text.replace("high = 600", "high = 600\nsteps = 1"))
    rows = run_all(file, tmp_path / "out")
    assert [row["program.kills"] for row in rows] == [0, 1, 3]
    assert [row["outcome"] for row in rows] == ["ok", "ok", "crashed"]
    assert rows[2]["error"] == "the worker ended in each of 3 tries: SIGKILL, SIGKILL, SIGKILL"
    assert [row["success"] for row in rows] == [True, True, False]
    assert [(tmp_path / f"tries{i}").read_text() for i in range(3)] == ["x", "xx", "xxx"]


@pytest.mark.long
def test_a_run_that_takes_too_long_is_given_up_with_its_program(campaign_file, tmp_path):
    script = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    more = program(script, tmp_path, table="ends_run = true")
    file = campaign_file(count=1, top="timeout_s = 5", more=more)
    file.write_text(file.read_text().replace("seconds = 0.02, ", ""))
    (row,) = run_all(file, tmp_path / "out")
    assert (row["outcome"], row["success"]) == ("timeout", False)
    assert row["error"] == "not done after timeout_s = 5"
    pid = int((tmp_path / "out/runs/000000/output.txt").read_text() or 0)
    assert not pid or gone(pid)


RESULT = """
import json, sys
told = json.load(open(sys.argv[2]))
json.dump({"twice": 2 * told["values"]["scene.speed_px_s"], "seed": str(told["seed"])}, open(sys.argv[1], "w"))
sys.exit(told["index"] % 2)
"""


def test_a_program_after_the_run_writes_columns(campaign_file, tmp_path):
    more = program(RESULT, tmp_path, "{result}", "{folder}/run.json", table='start = "after"')
    file = campaign_file(count=2, top='success = ["program", "result.twice > 0"]', more=more)
    rows = run_all(file, tmp_path / "out")
    assert [row["program.exit"] for row in rows] == [0, 1]
    assert [row["success"] for row in rows] == [True, False]
    assert [row["result.twice"] for row in rows] == [2 * row["scene.speed_px_s"] for row in rows]
    assert [row["result.seed"] for row in rows] == [str(row["seed"]) for row in rows]


def test_a_run_that_fails_is_a_row(tmp_path):
    (tmp_path / "own.toml").write_text('[scene]\nkind = "recording"\npath = "gone.npz"\n[run]\nseconds = 0.02')
    (tmp_path / "c.toml").write_text('rig = "own.toml"\ncount = 1')
    (row,) = run_all(tmp_path / "c.toml", tmp_path / "out")
    assert (row["outcome"], row["success"], row["index"]) == ("failed", False, 0)
    assert "gone.npz" in row["error"]


def test_what_no_run_can_mend_ends_the_campaign(campaign_file, tmp_path):
    folder = tmp_path / "out"
    more = program("", tmp_path)
    (folder / "rows").mkdir(parents=True)
    (folder / "runs").symlink_to("/sys")
    with pytest.raises(CampaignStopped, match="/runs/000000: "):
        run_all(campaign_file(count=2, more=more), folder)
    assert not os.listdir(rows_folder(folder))


def test_parts_of_a_job_array_have_every_run_once():
    parts = [part_of(f"{k}/3", 10) for k in (1, 2, 3)]
    assert sorted(i for part in parts for i in part) == list(range(10))
    assert part_of("3/10", 25) == range(2, 25, 10)
    for wrong in ("0/3", "4/3", "3", "a/b", "1/0", "-1/3"):
        with pytest.raises(ValueError, match="expected I/N"):
            part_of(wrong, 10)


@pytest.mark.long
def test_a_worker_ends_its_run_when_its_campaign_is_killed(campaign_file, tmp_path):
    more = program("import os, time; print(os.getppid(), flush=True); time.sleep(600)", tmp_path)
    file = campaign_file(count=1, more=more)
    file.write_text(file.read_text().replace("seconds = 0.02", "seconds = 600").replace('"free"', '"realtime"'))
    script = f"""
from pathlib import Path
from tests.emulator.campaign.test_running import run_all
run_all(Path({str(file)!r}), Path({str(tmp_path / "out")!r}))
"""
    output = tmp_path / "out/runs/000000/output.txt"
    with subprocess.Popen([sys.executable, "-c", script]) as campaign:
        until_s = time.monotonic() + 120
        while not output.exists() or not output.read_text().endswith("\n"):
            assert time.monotonic() < until_s
            time.sleep(0.05)
        campaign.kill()
    assert gone(int(output.read_text()))
    assert not (tmp_path / "out/runs/000000/program.pid").exists()
