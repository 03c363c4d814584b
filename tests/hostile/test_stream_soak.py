"""Four streams of a free-running camera through wraps of 2^15 us, and what the comparison sees.

EVSTIM_STREAM_HOURS=24 python -m pytest tests/hostile/test_stream_soak.py    # 40 times through 2^31 us too
"""

import os

import pytest

from tests.hostile.stream_soak import soak

HOURS = float(os.environ.get("EVSTIM_STREAM_HOURS", "0.02"))


@pytest.mark.long
@pytest.mark.system
@pytest.mark.socket
@pytest.mark.timeout(900 + HOURS * 3600)
def test_every_time_and_exposure_is_right_through_the_wraps():
    seen, summary = soak(HOURS)
    assert summary["balanced"], summary
    assert summary["links"]["usbip"]["error"] is None
    assert seen.device_us > HOURS * 3.6e9
    assert seen.frames >= HOURS * 3600 / 8 - 1
    assert seen.samples >= HOURS * 3600 * 5 - 1
    assert seen.edges >= HOURS * 3600 * 2 - 2
