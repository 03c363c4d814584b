"""A package outside the checkout, `tests/outsider`, adds a scene, a camera, a link, a fault, a format and a verb."""

import json
from pathlib import Path

import pytest

from tests.installed import evstim_in_turn, install

pytestmark = pytest.mark.system

OUTSIDER = Path(__file__).parents[1] / "outsider"

RIG = """
title = "A blinking light, reported by a beacon."
[scene]
kind = "blink"
period_ms = 10.0
[camera]
model = "{camera}"
[run]
seconds = 0.05
pace = "free"
[[links]]
kind = "beacon"
path = "{path}"
[[faults]]
kind = "muted"
at_s = 0.02
for_s = 0.01
"""


@pytest.fixture
def site(tmp_path):
    return install(OUTSIDER, tmp_path / "site")


def rig_file(tmp_path, camera="dot"):
    path = tmp_path / "beacon.toml"
    path.write_text(RIG.format(path=tmp_path / "count.txt", camera=camera))
    return path


def printed(done):
    return " ".join((done.err + done.out).split())


def test_a_run_with_all_that_a_package_adds(site, tmp_path):
    (done,) = evstim_in_turn(site, ["run", rig_file(tmp_path), "--json"])
    assert done.code == 0, done.err
    result = json.loads(done.out.splitlines()[-1])
    assert result["balanced"] is True
    (link,) = result["events"]["links"].values()
    (fault,) = result["links"]["beacon"]["faults"]
    assert fault["kind"] == "muted"
    assert fault["events_lost"] > 0
    assert link["delivered"] == int((tmp_path / "count.txt").read_text()) > 0


def test_a_recording_in_the_format_of_a_package(site, tmp_path):
    path, unknown = tmp_path / "events.lines", tmp_path / "of_unknown_origin"
    unknown.symlink_to(path)
    recorded, counted, converted, refused = evstim_in_turn(
        site,
        ["record", rig_file(tmp_path), path, "--json"],
        ["count", path],
        ["convert", unknown, tmp_path / "events.npz", "--json"],
        ["convert", unknown, tmp_path / "events.unknown"],
    )
    assert recorded.code == 0, recorded.err
    (recording,) = json.loads(recorded.out.splitlines()[-1])["links"]["file"]["recordings"]
    written = recording["written"]["events"]
    assert written > 1000
    assert counted.out.split() == [str(written)]
    assert converted.code == 0, converted.err
    assert json.loads(converted.out.splitlines()[-1])["events"] == written
    assert ".lines" in printed(refused)


def test_all_that_a_package_adds_is_listed(site):
    unknown = rig_file(site)
    unknown.write_text(unknown.read_text().replace('"muted"', '"mutd"'))
    told, listen, commands, fault = evstim_in_turn(
        site, ["schema"], ["listen", "--help"], ["--help"], ["check", unknown]
    )
    schema = json.loads(told.out)
    assert schema["$defs"]["BeaconLink"]["properties"]["kind"] == {"const": "beacon"}
    assert schema["$defs"]["Muted"]["properties"]["kind"] == {"const": "muted"}
    assert "period_ms" in schema["$defs"]["BlinkParameters"]["properties"]
    assert "dot" in schema["$defs"]["Camera"]["properties"]["model"]["enum"]
    assert "Read a beacon." in listen.out
    assert "Count the events of a file of lines." in commands.out
    assert "did you mean 'muted'" in printed(fault)


def test_a_check_of_the_package_is_reported_by_line(site, tmp_path):
    (done,) = evstim_in_turn(site, ["check", rig_file(tmp_path, "imx636")])
    assert done.code == 2
    assert "line 13: links[0].path: too large a camera" in printed(done)


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["blink", "dot", "beacon", "muted", "lines", "count"])
def test_a_broken_entry_point_is_reported_with_its_package_and_stops_nothing_else(name, tmp_path):
    site = install(OUTSIDER, tmp_path / "site", **{name: "outsider:MISSING"})
    rig = rig_file(tmp_path)
    convert = ["convert", rig, tmp_path / "a.npz", "--to", "lines"]
    users = {"lines": convert, "count": ["count", rig]}
    done, check, shown, misspelled = evstim_in_turn(
        site, users.get(name, ["check", rig]), ["check", "loopback"], ["--help"], ["recrod"]
    )
    assert done.code in (2, 3)
    assert f"entry point '{name}' (outsider:MISSING) of package outsider in group evstim." in printed(done)
    assert "AttributeError" in printed(done)
    assert check.code == shown.code == 0
    assert "Did you mean" in printed(misspelled)
