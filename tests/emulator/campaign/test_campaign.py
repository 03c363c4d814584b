"""A run is a function of the campaign's content and the run's index, and of nothing else."""

import pytest

from emulator.campaign.campaign import Campaign
from emulator.campaign.loading import CampaignError, load_source, with_worker


def test_values_lie_where_the_sampling_says(campaign):
    made = campaign(count=64)
    values = [made.values(i)["camera.sensor.threshold_on"] for i in range(64)]
    assert sorted(int((v - 0.1) / 0.4 * 64) for v in values) == list(range(64))
    for i in (0, 63):
        rig = made.rig(i)
        assert rig.camera.sensor.threshold_on == values[i]
        assert rig.scene.speed_px_s == made.values(i)["scene.speed_px_s"]
        assert rig.run.seed == made.seed(i)
    assert len({made.seed(i) for i in range(64)}) == 64


def test_what_does_not_change_the_runs_does_not_change_the_id(campaign_file):
    file = campaign_file()
    before = Campaign(load_source(file))
    file.write_text('title = "x" # told\nmin_success = 0.5\n' + file.read_text() + "[report]\ncolumns = []\n")
    after = Campaign(load_source(file))
    assert after.id == before.id
    assert after.rig(2) == before.rig(2)


@pytest.mark.parametrize(
    ("old", "new"), [("count = 4", "count = 5"), ("0.5", "0.6"), ("count = 4", "count = 4\nseed = 2"), ("16", "17")]
)
def test_what_changes_the_runs_changes_id_and_seeds(campaign_file, old, new):
    file = campaign_file()
    before = Campaign(load_source(file))
    file.write_text(file.read_text().replace(old, new, 1))
    after = Campaign(load_source(file))
    assert after.id != before.id
    assert after.seed(0) != before.seed(0)


def test_the_rigs_content_counts_and_not_its_place(tmp_path, campaign_file):
    file = campaign_file()
    file.write_text(file.read_text().replace('"checkerboard"', '"own.toml"'))
    ids = []
    for place, square in (("a", 5), ("b", 5), ("c", 6)):
        (tmp_path / place).mkdir()
        (tmp_path / place / "own.toml").write_text(f'[scene]\nkind = "checkerboard"\nsquare_px = {square}.0\n')
        (tmp_path / place / "small.toml").write_text(file.read_text())
        ids.append(Campaign(load_source(tmp_path / place / "small.toml")).id)
    assert ids[0] == ids[1] != ids[2]


def test_a_grid_runs_every_combination_repeatedly(campaign_file):
    file = campaign_file()
    text = file.read_text().replace("count = 4", 'sampling = "grid"\nrepeats = 3')
    file.write_text(text.replace("high = 0.5", "high = 0.5\nsteps = 5").replace("high = 600", "high = 600\nsteps = 2"))
    made = Campaign(load_source(file))
    assert made.runs == 30
    assert len({tuple(made.values(i).values()) for i in range(30)}) == 10
    assert made.values(0) == made.values(2) != made.values(3)
    assert made.seed(0) != made.seed(2)
    with pytest.raises(CampaignError, match="runs 0 to 29"):
        made.values(30)


def test_a_parameter_may_be_a_fault_of_a_link(campaign_file):
    file = campaign_file(more='[[parameters]]\nkey = "faults[0].rate"\nkind = "list"\nvalues = [1e-6, 1e-3]\n')
    text = file.read_text().replace("links = []", 'links = [{kind = "serial"}]\nfaults = [{kind = "bit_flips"}]')
    file.write_text(text)
    made = Campaign(load_source(file))
    assert {made.rig(i).faults[0].rate for i in range(4)} == {1e-6, 1e-3}


def test_also_gives_other_keys_the_same_value(campaign_file):
    file = campaign_file()
    key = 'key = "camera.sensor.threshold_on"'
    file.write_text(file.read_text().replace(key, f'{key}\nalso = ["camera.sensor.threshold_off"]'))
    sensor = Campaign(load_source(file)).rig(1).camera.sensor
    assert sensor.threshold_on == sensor.threshold_off


def test_a_worker_has_its_own_bus():
    table = {"links": [{"kind": "can", "channel": "vcan{worker}"}], "x": 3}
    assert with_worker(table, 2) == {"links": [{"kind": "can", "channel": "vcan2"}], "x": 3}
