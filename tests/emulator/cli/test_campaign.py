"""`evstim campaign` in the process of the tests where no signal ends it: resume, signals, job arrays, one run again."""

import json
import signal
import subprocess
import sys
import time

import pytest

from emulator.campaign.table import done_rows

pytestmark = pytest.mark.system

COMMAND = [sys.executable, "-c", "from emulator.cli import main; main()", "campaign"]
CAMPAIGN = """
title = "speeds"
rig = "loopback"
count = {count}
success = ["verdict", "events.read_out > 10"]
min_success = {least}
[set]
links = {links}
run = {{seconds = 0.02, pace = "free"}}
camera.sensor = {{width = 16, height = 16}}
[[parameters]]
key = "scene.speed_px_s"
kind = "uniform"
low = 50
high = 100
"""


@pytest.fixture
def file(tmp_path):
    def write(count=4, least=0.5, links="[]"):
        path = tmp_path / "speeds.toml"
        path.write_text(CAMPAIGN.format(count=count, least=least, links=links))
        return path

    return write


@pytest.fixture
def campaign(evstim):
    """Run `evstim campaign`, which ends with a code; return what it printed."""

    def run(*arguments, code=0):
        done = evstim("campaign", *arguments)
        assert done.code == code, done.err
        return done

    return run


def summary(done):
    return json.loads(done.out.splitlines()[-1])


def test_a_campaign_its_parts_and_its_completion(file, campaign):
    path = file(count=5)
    folder = path.with_suffix("")
    assert summary(campaign(path, "--part", "2/2", "--workers", "1", "--json"))["came"] == 2
    assert done_rows(folder / "rows") == {1, 3}
    assert summary(campaign(path, "--only", "4", "--json"))["came"] == 1
    assert not (folder / "report.html").exists()
    told = summary(campaign(path, "--json", "--workers", "1"))
    assert (told["came"], told["done"], told["outcomes"]) == (2, 5, {"ok": 5})
    assert told["success"]["successes"] == 5
    assert (folder / "report.html").exists()
    assert (folder / "rows.parquet").exists()
    assert summary(campaign(path, "--json"))["came"] == 0
    path.write_text(path.read_text().replace("100", "101"))
    assert "campaign.parameters[0].high was 100, is 101" in summary(campaign(path, "--json", code=2))["error"]


@pytest.mark.long
def test_too_few_successes_end_with_1(file, campaign, tmp_path):
    path = file(count=1, least=1.0)
    path.write_text(path.read_text().replace("read_out > 10", "read_out > 1000000"))
    out = campaign(path, "--folder", tmp_path / "here", code=1).out
    assert "success: 0 of 1" in out
    assert "speeds: 1 of 1 run is done" in out


@pytest.mark.long
@pytest.mark.sampled
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_a_summary_and_it_goes_on(file, number):
    path = file(count=3000)
    rows = path.with_suffix("") / "rows"
    command = [*COMMAND, str(path), "--workers", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        until_s = time.monotonic() + 300
        while len(done_rows(rows)) < 3:
            assert run.poll() is None, run.stderr.read()
            assert time.monotonic() < until_s
            time.sleep(0.05)
        run.send_signal(number)
        out, err = run.communicate(timeout=300)
    assert run.returncode == 1, err
    assert "Traceback" not in err
    assert f"{len(done_rows(rows))} of 3000 runs are done" in out
    assert "interrupted: the same command goes on" in out


@pytest.mark.long
def test_a_run_again_is_equal_bit_for_bit(file, campaign, tmp_path):
    path = file(count=2, links='[{kind = "loopback"}]')
    campaign(path, "--workers", "1")
    record = tmp_path / "again.npz"
    told = summary(campaign("again", path, "1", "--record", record, "--json"))
    assert told["different"] == []
    assert told["row"]["link.loopback.delivered"] == told["row"]["events.read_out"] > 0
    assert record.stat().st_size > 1000
    assert "there is no run 2" in campaign("again", path, "2", code=2).err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "4"], "there is no run 4"),
        (["--part", "0/3"], "--part: expected I/N"),
        (["--part", "1/3", "--only", "1"], "give one of them"),
        (["--workers", "0"], "--workers must be 1 to 1024"),
        (["--workers", "1", "--scheduler", "tcp://127.0.0.1:9"], "give one of them"),
        (["--folder", "/dev/null/x"], "--folder: "),
        (["--only", "1", "--report", "r"], "--report: a part of a campaign writes no report"),
        (["--part", "1/3", "--report", "r"], "--report: a part of a campaign writes no report"),
    ],
)
def test_wrong_use(file, campaign, arguments, message):
    assert message in " ".join(campaign(file(), *arguments, code=2).err.split())


def test_a_report_of_the_runs_that_are_done(file, campaign, tmp_path):
    path = file(count=3)
    assert "give its --folder" in campaign("report", path, code=2).err
    campaign(path, "--part", "1/2", "--workers", "1")
    told = summary(campaign("report", path, "--to", tmp_path / "there", "--json"))
    assert (told["done"], told["runs"], told["came"]) == (2, 3, 0)
    assert "1 of 3 runs are missing" in (tmp_path / "there" / "report.html").read_text()
    path.write_text(path.read_text().replace("100", "101"))
    assert "was 100, is 101" in summary(campaign("report", path, "--json", code=2))["error"]
