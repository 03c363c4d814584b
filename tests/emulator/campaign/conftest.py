"""Small campaigns: a checkerboard before 16 x 16 pixels, no link, a twentieth of a second."""

import pytest

from emulator.campaign.campaign import Campaign
from emulator.campaign.loading import load_source

SMALL = """
rig = "checkerboard"
count = {count}
{top}
[set]
links = []
run = {{seconds = 0.02, pace = "free"}}
[set.camera.sensor]
width = 16
height = 16
[[parameters]]
key = "camera.sensor.threshold_on"
kind = "uniform"
low = 0.1
high = 0.5
[[parameters]]
key = "scene.speed_px_s"
kind = "log-uniform"
low = 30
high = 600
{more}
"""


@pytest.fixture
def campaign_file(tmp_path):
    """Write a small campaign; `top` are keys of the file, `more` are tables."""

    def write(count=4, top="", more="", name="small.toml"):
        path = tmp_path / name
        path.write_text(SMALL.format(count=count, top=top, more=more))
        return path

    return write


@pytest.fixture
def campaign(campaign_file):
    """Load such a campaign."""
    return lambda *args, **kwargs: Campaign(load_source(campaign_file(*args, **kwargs)))
