"""`evstim run --report`: a page that stands alone, JSON and JUnit that agree with the run, and an exit code."""

import hashlib
import json
import re
from xml.etree import ElementTree

import jsonschema
import pytest

from emulator.run.report.content import report_schema

pytestmark = pytest.mark.system

RIG = """
[scene]
kind = "checkerboard"
square_px = 20.0
speed_px_s = 60.0
[camera]
model = "davis346"
[run]
pace = "free"
seconds = 0.3
seed = 1
[[links]]
kind = "loopback"
[verdict]
{rules}
"""


@pytest.fixture
def run(evstim, tmp_path):
    def run_rig(rules=""):
        rig = tmp_path / "small.toml"
        rig.write_text(RIG.format(rules=rules))
        done = evstim("run", rig, "--json", "--report", tmp_path / "out")
        return done.code, json.loads(done.out.splitlines()[-1]), tmp_path / "out"

    return run_rig


def test_a_good_run_has_a_whole_report(run, tmp_path):
    (tmp_path / "out").mkdir()
    code, said, folder = run("max_drop = 0.0\nmin_rate_hz = 1000")
    assert code == 0
    page = (folder / "report.html").read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert page.count("<svg") == 4  # rates, two bars of fates, intervals; without pacing there is no latency
    assert page.count("<img") >= 4  # maps of both polarities, pictures
    assert hashlib.sha256((folder.parent / "small.toml").read_bytes()).hexdigest() in page
    assert "verdict.max_drop loopback" in page
    numbers = json.loads((folder / "report.json").read_text())
    assert numbers["verdict"] == "good"
    assert numbers["events"] == said["events"]
    jsonschema.validate(numbers, report_schema(), jsonschema.Draft202012Validator)
    assert sum(numbers["timeline"]["on"]) + sum(numbers["timeline"]["off"]) == said["events"]["read_out"]
    assert numbers["modelled"]["probed"]
    cases = ElementTree.parse(folder / "junit.xml").findall(".//testcase")
    assert [case.get("name") for case in cases] == [one["rule"] for one in said["rules"]]
    assert not ElementTree.parse(folder / "junit.xml").findall(".//failure")
    assert (folder / "report.html").stat().st_size < 1_000_000


def test_a_broken_rule_is_told_everywhere_and_ends_with_one(run):
    code, said, folder = run("max_rate_hz = 10")
    assert code == 1
    assert [one["rule"] for one in said["rules"] if not one["good"]] == ["verdict.max_rate_hz"]
    assert json.loads((folder / "report.json").read_text())["verdict"] == "bad"
    (failure,) = ElementTree.parse(folder / "junit.xml").findall(".//failure")
    assert "at most 10" in failure.get("message")


def test_a_file_in_the_place_of_the_folder_is_wrong_use(evstim, tmp_path):
    (tmp_path / "out").write_text("not a folder")
    done = evstim("run", "loopback", "--report", tmp_path / "out")
    assert done.code == 2
    assert "--report" in done.err
    assert (tmp_path / "out").read_text() == "not a folder"
