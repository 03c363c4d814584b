"""A package outside the checkout, `tests/outsider`, adds a scene, a camera, a link, a fault, a format and a verb."""

import json
from pathlib import Path

import pytest

from tests.installed import evstim, install

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
    return " ".join((done.stderr + done.stdout).split())


def test_a_run_with_all_that_a_package_adds(site, tmp_path):
    done = evstim(site, "run", rig_file(tmp_path), "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["balanced"] is True
    (link,) = result["events"]["links"].values()
    (fault,) = result["links"]["beacon"]["faults"]
    assert fault["kind"] == "muted"
    assert fault["events_lost"] > 0
    assert link["delivered"] == int((tmp_path / "count.txt").read_text()) > 0


def test_a_recording_in_the_format_of_a_package(site, tmp_path):
    path = tmp_path / "events.lines"
    done = evstim(site, "record", rig_file(tmp_path), path, "--json")
    assert done.returncode == 0, done.stderr
    (recording,) = json.loads(done.stdout.splitlines()[-1])["links"]["file"]["recordings"]
    written = recording["written"]["events"]
    assert written > 1000
    assert evstim(site, "count", path).stdout.split() == [str(written)]
    path = path.rename(tmp_path / "of_unknown_origin")
    done = evstim(site, "convert", path, tmp_path / "events.npz", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["events"] == written
    assert ".lines" in printed(evstim(site, "convert", path, tmp_path / "events.unknown"))


def test_all_that_a_package_adds_is_listed(site):
    schema = json.loads(evstim(site, "schema").stdout)
    assert schema["$defs"]["BeaconLink"]["properties"]["kind"] == {"const": "beacon"}
    assert schema["$defs"]["Muted"]["properties"]["kind"] == {"const": "muted"}
    assert "period_ms" in schema["$defs"]["BlinkParameters"]["properties"]
    assert "dot" in schema["$defs"]["Camera"]["properties"]["model"]["enum"]
    assert "Read a beacon." in evstim(site, "listen", "--help").stdout
    assert "Count the events of a file of lines." in evstim(site, "--help").stdout
    assert "did you mean 'muted'" in printed(evstim(site, "check", _with_fault(site, "mutd")))


def _with_fault(folder, kind):
    rig = rig_file(folder)
    rig.write_text(rig.read_text().replace('"muted"', f'"{kind}"'))
    return rig


def test_a_check_of_the_package_is_reported_by_line(site, tmp_path):
    done = evstim(site, "check", rig_file(tmp_path, "imx636"))
    assert done.returncode == 2
    assert "line 13: links[0].path: too large a camera" in printed(done)


@pytest.mark.sampled
@pytest.mark.parametrize("name", ["blink", "dot", "beacon", "muted", "lines", "count"])
def test_a_broken_entry_point_is_reported_with_its_package_and_stops_nothing_else(name, tmp_path):
    site = install(OUTSIDER, tmp_path / "site", **{name: "outsider:MISSING"})
    rig = rig_file(tmp_path)
    if name == "lines":
        done = evstim(site, "convert", rig, tmp_path / "a.npz", "--to", "lines")
    else:
        done = evstim(site, *(["count", rig] if name == "count" else ["check", rig]))
    assert done.returncode in (2, 3)
    assert f"entry point '{name}' (outsider:MISSING) of package outsider in group evstim." in printed(done)
    assert "AttributeError" in printed(done)
    assert evstim(site, "check", "loopback").returncode == 0
    assert evstim(site, "--help").returncode == 0
    assert "Did you mean" in printed(evstim(site, "recrod"))


@pytest.mark.long
def test_a_package_that_cannot_be_imported_stops_only_rigs_that_name_it(site, tmp_path):
    (site / "outsider.py").write_text("raise RuntimeError('half installed')\n")
    done = evstim(site, "check", rig_file(tmp_path))
    assert done.returncode == 2
    assert "of package outsider" in printed(done)
    assert "half installed" in printed(done)
    for command in (["check", "loopback"], ["schema"], ["listen", "--help"], ["--help"]):
        assert evstim(site, *command).returncode == 0


def test_a_path_within_a_record_is_reported_with_its_package(site, tmp_path):
    module = site / "outsider.py"
    module.write_text(module.read_text().replace('"outsider:factory_of"', '"outsider:gone"'))
    done = evstim(site, "run", rig_file(tmp_path))
    assert done.returncode == 3
    assert "package outsider in group evstim.links: outsider:gone cannot be imported" in printed(done)
