"""The pytest plugin, used as a flight-software project uses it: pytest in a process of its own, on files of its own."""

import json
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

pytestmark = pytest.mark.system
pytest_plugins = ["pytester"]

RIG = """
title = "small"
[scene]
kind = "checkerboard"
square_px = 8.0
speed_px_s = 60.0
[camera]
model = "davis346"
[run]
step_us = 1000
{run}
seed = 1
[[links]]
kind = "{kind}"
{more}
"""


@pytest.fixture
def project(pytester):
    """(test source, rig kind, more keys, keys of [run], options) -> the finished pytest, in this process."""

    def run(source, *options, kind="loopback", more="", run="max_late_ms = 0"):
        (pytester.path / "small.toml").write_text(RIG.format(kind=kind, more=more, run=run))
        (pytester.path / "test_it.py").write_text("import pytest\n" + source)
        plugin = () if _is_installed() else ("-p", "evstim.testing.plugin")
        done = pytester.runpytest_inprocess("-q", "-rs", "-p", "no:cacheprovider", *plugin, *options)
        return SimpleNamespace(returncode=done.ret, stdout=done.stdout.str())

    return run


def _is_installed():
    from importlib.metadata import entry_points

    return any(point.value == "evstim.testing.plugin" for point in entry_points(group="pytest11"))


def test_a_rig_runs_while_the_test_does_and_its_ledger_is_asserted(project):
    done = project("""
@pytest.mark.rig("small.toml", pace="free", seconds=0.2)
def test_it(evstim_rig):
    assert list(evstim_rig.addresses) == ["loopback"]
    result = evstim_rig.stop()
    assert result.ledger.read_out > 1000
    assert len(evstim_rig.recent_events()) == result.ledger.read_out
""")
    assert done.returncode == 0, done.stdout
    assert "1 passed" in done.stdout


def test_of_a_failed_test_the_events_and_counts_are_kept(project, pytester):
    faery = pytest.importorskip("faery", reason="AEDAT 4.0 (extra files)")
    done = project("""
import time
@pytest.mark.rig("small.toml", pace="free", seconds=0.2, keep_s=0.05)
def test_it(evstim_rig):
    while evstim_rig.status.sim_seconds < 0.15:
        time.sleep(0.01)
    assert False, "the flight software is wrong"
""")
    assert done.returncode == 1
    (folder,) = (pytester.path / "evstim-artefacts").iterdir()
    assert str(folder / "events.aedat4") in done.stdout
    assert (folder / "report.html").exists()
    counts = json.loads((folder / "summary.json").read_text())
    assert counts["balanced"] is True
    events = np.concatenate([packet for packet in faery.events_stream_from_file(folder / "events.aedat4")])
    assert 0 < len(events) < counts["events"]["read_out"]
    assert events["t"][-1] - events["t"][0] <= 60_000


@pytest.mark.long
def test_the_page_of_a_failed_test_names_it_and_does_not_judge_lateness(project, pytester):
    done = project(
        """
@pytest.mark.rig("small.toml", seconds=0.05)
def test_it(evstim_rig):
    while evstim_rig.status.lateness.frames_late == 0:
        pass
    assert False, "the flight software is wrong"
""",
        run="max_late_ms = 0.001\nmax_late_share = 0.0\nlead_us = 0",
    )
    assert "1 failed" in done.stdout, done.stdout
    (folder,) = (pytester.path / "evstim-artefacts").iterdir()
    page = (folder / "report.html").read_text()
    assert "run by the test test_it.py::test_it" in page
    assert "GOOD</strong>All 2 rules were kept." in page
    assert re.search(r">began</th><td[^>]*>20\d\d-.*?>ended</th><td[^>]*>20\d\d-", page)
    assert "Effects of the plan" in page
    report = json.loads((folder / "report.json").read_text())
    assert (report["verdict"], report["lateness"]["too_late"]) == ("good", True)


def test_the_plugin_loads_pytest_alone():
    """Every pytest session of a machine with evstim loads it."""
    heavy = ("numpy", "numba", "msgspec", "emulator", "transports", "firmware_protocol")
    code = f"import sys, evstim.testing.plugin; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.strip() == "[]"


LACKING = """
@pytest.mark.rig("small.toml")
def test_it(evstim_rig):
    pass
"""


@pytest.mark.long
def test_what_the_machine_lacks_is_a_skip_with_its_reason(project):
    done = project(LACKING, kind="serial", more='port = "/dev/there-is-none"')
    assert done.returncode == 0, done.stdout
    assert "1 skipped" in done.stdout
    assert "/dev/there-is-none" in done.stdout


@pytest.mark.long
def test_or_a_failure_where_that_is_asked_for(project):
    done = project(LACKING, "--evstim-require", kind="serial", more='port = "/dev/there-is-none"')
    assert done.returncode == 1
    assert "1 error" in done.stdout


@pytest.mark.long
def test_a_link_that_dies_fails_the_test_at_its_end(project):
    done = project("""
import os, signal
@pytest.mark.rig("small.toml")
def test_it(evstim_rig):
    import multiprocessing
    (link,) = multiprocessing.active_children()
    os.kill(link.pid, signal.SIGKILL)
""")
    assert done.returncode == 1
    assert "1 passed, 1 error" in done.stdout, done.stdout


@pytest.mark.long
@pytest.mark.parametrize(
    ("mark", "says"),
    [("", "needs a mark with a rig"), ('@pytest.mark.rig("small.toml", second=1)', "seconds, seed, pace")],
)
def test_wrong_use_says_what_is_right(project, mark, says):
    done = project(f"{mark}\ndef test_it(evstim_rig):\n    pass\n")
    assert done.returncode == 1
    assert says in done.stdout
