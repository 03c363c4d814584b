"""The folder of a campaign belongs to one campaign, and to one program at a time."""

import json

import pytest

from emulator.campaign.campaign import Campaign
from emulator.campaign.loading import load_source
from emulator.campaign.table import FolderError, begin_folder, working_in


def test_the_same_campaign_goes_on(campaign, tmp_path):
    folder = tmp_path / "out"
    assert begin_folder(campaign(), folder) == ""
    assert begin_folder(campaign(), folder) == ""
    assert json.loads((folder / "campaign.json").read_text())["id"] == campaign().id
    assert sorted(path.name for path in folder.iterdir()) == ["campaign.json", "rows"]


def test_an_edited_campaign_is_refused_with_what_differs(campaign_file, tmp_path):
    folder, file = tmp_path / "out", campaign_file()
    begin_folder(Campaign(load_source(file)), folder)
    file.write_text(file.read_text().replace("high = 0.5", "high = 0.6").replace("count = 4", 'count = 8\nrecord = ""'))
    with pytest.raises(FolderError) as refused:
        begin_folder(Campaign(load_source(file)), folder)
    told = str(refused.value)
    assert "campaign.count was 4, is 8; campaign.parameters[0].high was 0.5, is 0.6; " in told
    assert 'campaign.record was not there, is ""' in told
    assert "give another --folder" in told


def test_an_edited_rig_is_refused(campaign_file, tmp_path):
    file, rig = campaign_file(), tmp_path / "own.toml"
    file.write_text(file.read_text().replace('"checkerboard"', '"own.toml"'))
    rig.write_text('[scene]\nkind = "checkerboard"\nsquare_px = 5.0\n')
    begin_folder(Campaign(load_source(file)), tmp_path / "out")
    rig.write_text('[scene]\nkind = "checkerboard"\nsquare_px = 6.0\n')
    with pytest.raises(FolderError, match=r"rig\.scene\.square_px was 5\.0, is 6\.0"):
        begin_folder(Campaign(load_source(file)), tmp_path / "out")


def test_rows_of_another_version_are_remarked(campaign, tmp_path):
    begin_folder(campaign(), tmp_path / "out")
    file = tmp_path / "out" / "campaign.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "evstim": "0.0.1"}))
    assert "rows of evstim 0.0.1" in begin_folder(campaign(), tmp_path / "out")


def test_two_programs_do_not_work_in_one_folder(tmp_path):
    with working_in(tmp_path, alone=True):
        for alone in (True, False):
            with pytest.raises(FolderError, match="another evstim campaign works"), working_in(tmp_path, alone=alone):
                pass
    with working_in(tmp_path, alone=False), working_in(tmp_path, alone=False):
        pass


def test_what_a_killed_program_had_begun_to_write_is_removed(tmp_path):
    (tmp_path / "rows").mkdir()
    for name in (".00000001.parquet.77.part", "00000002.parquet"):
        (tmp_path / "rows" / name).touch()
    with working_in(tmp_path, alone=False):
        assert len(list((tmp_path / "rows").iterdir())) == 2  # another job may be writing it
    with working_in(tmp_path, alone=True):
        assert [path.name for path in (tmp_path / "rows").iterdir()] == ["00000002.parquet"]
