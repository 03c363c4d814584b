"""Mistakes in a campaign file are told with line, key and what would be right."""

import pytest

from emulator.campaign.campaign import Campaign
from emulator.campaign.loading import CampaignError, load_source
from emulator.rig.loading import RigError

PROGRAM = '[program]\nargv = ["true"]\n'


@pytest.mark.parametrize(
    ("top", "more", "message"),
    [
        ("sucess = []", "", "line 4: sucess: 'sucess' is not known here; did you mean 'success'"),
        ('sampling = "sobel"', "", "line 4: sampling: 'sobel' is not known here; did you mean 'sobol'"),
        ("repeats = 0", "", "line 4: repeats: repeats must be 1"),
        ("timeout_s = 0", "", "timeout_s must be above 0"),
        ('record = "npz"', "", "record must be a suffix"),
        ('record = ".npz"', "", "record: this rig has no link"),
        ('success = ["verdit"]', "", 'line 4: success: expected "verdict"'),
        ('success = ["events.readout > 3"]', "", "'events.readout' is not known here; did you mean 'events.read_out'"),
        ('success = ["program"]', "", "'program' needs a .program."),
        ("", '[report]\ncolumns = ["events.raise"]', "did you mean 'events.raised'"),
        ("", '[report]\nworst_is = "low"', "worst_is: 'low' is not known here; did you mean 'lowest'"),
        ("", '[[parameters]]\nkey = "scene.bright"\nkind = "unifrom"', "did you mean 'uniform'"),
        ("", '[[parameters]]\nkey = "scene.bright"\nkind = "uniform"\nlow = 1', "line 24: parameters.2..low"),
        ("", '[[parameters]]\nkind = "uniform"\nlow = 1\nhigh = 2', "'key' is missing"),
        ("", '[[parameters]]\nkey = "scene.speed_px_s"\nkind = "list"\nvalues = [1]', "given by an earlier parameter"),
        ("", '[[parameters]]\nkey = "scene..x"\nkind = "list"\nvalues = [1]', "key must be like"),
        ("", '[[parameters]]\nkey = "faults[0].rate"\nkind = "list"\nvalues = [1]', "not in the rig, which has 0"),
        ("", '[[parameters]]\nkey = "scene.brigth"\nkind = "list"\nvalues = [1]', "did you mean 'bright'"),
        ("", '[[parameters]]\nkey = "program.gain"\nkind = "list"\nvalues = [1]', "there is no .program."),
        ("", '[[parameters]]\nkey = "run.step_us"\nkind = "uniform"\nlow = 1\nhigh = 9', "a whole number of us"),
        ("", '[[parameters]]\nkey = "run.seed"\nkind = "list"\nvalues = [1]', "each run has a seed of its own"),
        (
            "",
            '[[parameters]]\nkey = "scene"\nkind = "list"\nvalues = [{}]',
            "line 22: .*scene replaces scene.speed_px_s",
        ),
        (
            "",
            '[[parameters]]\nkey = "run.pace"\nkind = "list"\nvalues = ["free"]',
            "run.pace replaces run.pace, given in",
        ),
        ("", '[[parameters]]\nkey = "scene.bright"\nkind = "uniform"\nlow = 1\nhigh = 2\nsteps = 3', "line 26: .*grid"),
        ("", '[[parameters]]\nkey = "run.seconds"\nkind = "list"\nvalues = [1, 0]', "run.seconds replaces"),
        ("", '[report.labels]\n"events.raise" = "events"', "did you mean 'events.raised'"),
        ("", '[report]\ncolumns = ["result.error"]', "'result.error' needs a .program."),
        ("", '[truth]\nlayers = ["depth"]', "line 22: truth.layers: this scene has no depth"),
        ("", "[truth]\nrate_hz = 5000.0", "line 22: truth.rate_hz: 5000 needs run.step_us of at most 200"),
        ("", "[program]\nargv = []", "argv must name a program"),
        ("", '[program]\nargv = ["a"]\nstart = "after"\nends_run = true', "cannot end it"),
        ("", '[program]\nargv = ["no-such-program"]', "no-such-program"),
        ("", '[program]\nargv = ["true", "{adress}"]', "placeholder 'adress' is not known here"),
        ("", '[program]\nargv = ["true", "{record}"]', "needs record ="),
    ],
)
def test_a_mistake_is_told(campaign_file, top, more, message):
    with pytest.raises(CampaignError, match=message):
        Campaign(load_source(campaign_file(top=top, more=more)))


def test_a_value_out_of_a_rigs_bounds_is_found_before_the_first_run(campaign_file):
    more = '[[parameters]]\nkey = "run.step_us"\nkind = "list"\nvalues = [1000, 0]\n'
    made = Campaign(load_source(campaign_file(count=16, more=more)))
    with pytest.raises(CampaignError, match=r"line 21: .*run\.step_us = 0 in run \d+: step_us must be 1 to"):
        made.check_all(range(16))


@pytest.mark.parametrize(
    ("right", "wrong", "told"),
    [
        ("width = 16", "widht = 16", r"line 9: .*'widht' is not known here; did you mean 'width'"),
        ("seconds = 0.02", "seed = 3, seconds = 0.02", r"line 7: set\.run\.seed: each run has a seed of its own"),
    ],
)
def test_a_mistake_in_set_is_told_there(campaign_file, right, wrong, told):
    file = campaign_file()
    file.write_text(file.read_text().replace(right, wrong))
    with pytest.raises(CampaignError, match=told):
        Campaign(load_source(file))


def test_a_run_that_would_never_end_is_refused(campaign_file):
    file = campaign_file()
    file.write_text(file.read_text().replace("seconds = 0.02, ", ""))
    with pytest.raises(CampaignError, match="would never end"):
        Campaign(load_source(file))
    file.write_text(file.read_text() + PROGRAM + "ends_run = true\n")
    Campaign(load_source(file))


def test_files_that_cannot_be_read(tmp_path, campaign_file):
    with pytest.raises(CampaignError, match="no such file"):
        load_source(tmp_path / "gone.toml")
    bad = tmp_path / "bad.toml"
    bad.write_text("rig = [")
    with pytest.raises(CampaignError, match="not valid TOML"):
        load_source(bad)
    bad.write_text("count = 3")
    with pytest.raises(CampaignError, match="'rig' is missing"):
        load_source(bad)
    bad.write_text('rig = "chekerboard"')
    with pytest.raises(RigError, match="did you mean 'checkerboard'"):
        load_source(bad)


def test_a_rig_beside_the_campaign_is_found(tmp_path, campaign_file, monkeypatch):
    (tmp_path / "own.toml").write_text('[scene]\nkind = "checkerboard"\nsquare_px = 5.0\n')
    file = campaign_file()
    file.write_text(file.read_text().replace('"checkerboard"', '"own.toml"'))
    monkeypatch.chdir("/")
    assert Campaign(load_source(file)).rig(0).scene.square_px == 5.0
