"""OpenEB, unmodified, opens a GenX320 that is not there, and sees every event in each of its formats.

Short by default; at length:

    EVSTIM_GENX320_EVENTS=1e6 EVSTIM_OPENEB_CLIENT=BUILD/client python -m pytest tests/guest/test_genx320.py
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.sensor.presets import PRESETS
from firmware_protocol.events import EDGE, EVENT, EdgeKind
from tests.guest.attachment import EVK4, Attachment
from tests.guest.comparison import assert_same
from tests.guest.machine import Guest
from tests.guest.running_rig import RunningRig
from tests.guest.test_evk4 import RIG, assert_same_triggers
from tests.hostile.looped import Looped
from transports.recording.word_files import EvtReader

EVENTS = round(float(os.environ.get("EVSTIM_GENX320_EVENTS", "3e4")))
GAP_US = 4
TIMEOUT_S = 240.0 + 8.0 * EVENTS * GAP_US * 1e-6
OPENEB = os.environ.get("EVSTIM_OPENEB_CLIENT", "")
FORMS = {"EVT21": (8, "evt21"), "EVT2": (4, "evt2"), "EVT3": (2, "evt3")}
CROPPED, MASKED, LIMIT = (180, 230), (100 - 60, 120 - 50), 20  # as openeb/client.cpp has them

pytestmark = [
    pytest.mark.guest,
    pytest.mark.socket,
    pytest.mark.timeout(2 * TIMEOUT_S + 1200),
    pytest.mark.skipif(
        not OPENEB, reason="EVSTIM_OPENEB_CLIENT names no program; tests/guest/openeb/Makefile builds it"
    ),
]


def looped(folder: Path, count: int = 1_000_000) -> None:
    """Save the recording that the rig plays in a loop."""
    looped, draw = Looped(count, 1), np.random.default_rng(2)
    looped.events["x"], looped.events["y"] = draw.integers(0, 320, count), draw.integers(0, 320, count)
    looped.events["t"] *= GAP_US
    looped.save(folder / "looped.npz")


@pytest.mark.shows("genx320", "openeb", "opens", "events", "triggers")
@pytest.mark.parametrize("form", FORMS)
def test_openeb_sees_every_event_that_its_settings_select(guest: Guest, tmp_path: Path, form: str) -> None:
    """Its own discovery, device, bias, window, masks, crop, filters, rate control, monitoring, stream and decoder."""
    looped(tmp_path)
    out = f"genx320-{form}.bin"
    with RunningRig(tmp_path, text=RIG.replace('"evk4"', '"genx320"')) as rig, Attachment(guest, rig.port, model=EVK4):
        command = [OPENEB, str(EVENTS), str(TIMEOUT_S), guest.path_in_guest(out), form]
        about: dict[str, Any] = json.loads(guest.check(command, 2 * TIMEOUT_S).splitlines()[-1])
    word_bytes, name = FORMS[form]
    assert (about["serial"], about["sensor"], about["word_bytes"]) == ("0badcafe", "GenX320MP", word_bytes)
    assert about["bias_diff_on"] == 25 + 25
    assert about["anti_flicker"] is True
    assert (about["celsius"], about["lux"]) == (20, 100)
    assert about["dead_time_us"] == PRESETS["genx320"].refractory_us
    seen = np.fromfile(guest.results / out, EVENT)
    assert len(seen) >= EVENTS
    sent = rig.delivered.events[rig.delivered.resets[-1] :]
    assert_same(seen, sent, offset_us=0)
    triggers = np.array([(t, EdgeKind.RISING if on else EdgeKind.FALLING, 0, 0) for t, on in about["triggers"]], EDGE)
    assert_same_triggers(triggers, rig.delivered)
    assert (seen["x"].min(), seen["y"].min()) == (0, 0)
    assert (seen["x"].max() + 1, seen["y"].max() + 1) == CROPPED
    assert not np.any((seen["x"] == MASKED[0]) & (seen["y"] == MASKED[1]))
    assert np.bincount(seen["t"].astype(np.int64) // 100).max() == LIMIT
    recorded = EvtReader(guest.results / f"{out}.raw", None)
    assert (recorded.facts.size, recorded.facts.camera) == ((320, 320), name)
    assert_same(np.concatenate([part.events for part in recorded.parts()]), sent, offset_us=0)
    assert rig.summary["balanced"], rig.summary
