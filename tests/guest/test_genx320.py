"""OpenEB, unmodified, opens a GenX320 that is not there, and sees every event in each of its formats.

Short by default; at length:

    EVSTIM_GENX320_EVENTS=1e6 EVSTIM_OPENEB_CLIENT=BUILD/client python -m pytest tests/guest/test_genx320.py
"""

import os

import numpy as np
import pytest

from emulator.sensor.presets import PRESETS
from tests.guest.running_rig import RunningRig
from tests.guest.test_evk4 import GAP_US, looped, needs_openeb, read_by_openeb, rig_of

EVENTS = round(float(os.environ.get("EVSTIM_GENX320_EVENTS", "3e4")))
SIZE = (320, 320)
TIMEOUT_S = 240.0 + 8.0 * EVENTS * GAP_US * 1e-6
FORMS = {"EVT21": (8, "evt21"), "EVT2": (4, "evt2"), "EVT3": (2, "evt3")}
CROPPED, MASKED, LIMIT = (180, 230), (100 - 60, 120 - 50), 20  # as openeb/client.cpp has them

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(2 * TIMEOUT_S + 1200), needs_openeb]


@pytest.mark.shows("genx320", "openeb", "opens", "events", "triggers")
@pytest.mark.parametrize("form", FORMS)
def test_openeb_sees_every_event_that_its_settings_select(guest, tmp_path, form):
    looped(tmp_path, SIZE)
    rig = RunningRig(tmp_path, text=rig_of("genx320"))
    about, seen = read_by_openeb(guest, rig, f"genx320-{form}.bin", EVENTS, form, timeout_s=TIMEOUT_S)
    word_bytes, name = FORMS[form]
    assert (about["sensor"], about["word_bytes"], about["file"]) == ("GenX320MP", word_bytes, (SIZE, name))
    assert about["bias_diff_on"] == 25 + 25
    assert about["anti_flicker"] is True
    assert (about["celsius"], about["lux"]) == (20, 100)
    assert about["dead_time_us"] == PRESETS["genx320"].refractory_us
    assert (seen["x"].min(), seen["y"].min()) == (0, 0)
    assert (seen["x"].max() + 1, seen["y"].max() + 1) == CROPPED
    assert not np.any((seen["x"] == MASKED[0]) & (seen["y"] == MASKED[1]))
    assert np.bincount(seen["t"].astype(np.int64) // 100).max() == LIMIT
