"""Basilisk's VizMessage: from Basilisk itself, from a writer that knows nothing of our description, and broken."""

import math
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.vizard import Update, UpdateError

sys.path.insert(0, str(Path(__file__).parent))

from wire_writer import bsk_update, field, update

FINITE = st.floats(allow_nan=False, allow_infinity=False)
TRIPLES = st.tuples(FINITE, FINITE, FINITE)
AT_REST = [0.0, 0.0, 0.0]


def test_an_update_of_basilisk():
    seen = Update(bsk_update())
    assert (seen.time_ns, seen.frame) == (40_000_000, 1)
    assert seen.spacecraft("seeker") == seen.spacecraft("")
    assert seen.spacecraft("seeker").position_m == (-167891380264.70248, 52299414786.254448, -20894522096.637875)
    assert seen.spacecraft("seeker").rotation == (-0.10766739317691931, -0.23707178686508151, 0.30566724044445032)
    assert seen.body("eros").position_m == (-167891470472.47937, 52299565132.369278, -20894618318.162567)
    assert seen.body("eros").rotation[0] == -0.025314061929947923
    camera = seen.camera(1)
    assert (camera.parent, camera.size, camera.position_m) == ("seeker", (346, 260), (0.2, -0.1, 0.5))
    assert camera.field_of_view_deg == pytest.approx(2 * math.degrees(math.atan(130 / 933.39)), abs=1e-3)


@given(st.integers(0, 1 << 53), TRIPLES, TRIPLES, st.text(max_size=5), st.integers(0, 1 << 40))
def test_what_is_written_is_read(t_ns, position, rotation, name, camera):
    data = update(t_ns, [(name, position, rotation)], cameras=[(camera, name, rotation, position)])
    seen = Update(data)
    assert seen.time_ns == t_ns
    assert (seen.spacecraft(name).position_m, seen.spacecraft(name).rotation) == (position, rotation)
    assert (seen.camera(camera).position_m, seen.camera(camera).direction) == (rotation, position)


@given(st.binary(max_size=300))
def test_any_bytes_are_an_update_or_refused(data):
    try:
        seen = Update(data)
    except UpdateError:
        return
    assert 0 <= seen.time_ns <= 1 << 53


@given(st.data())
def test_a_damaged_update_is_read_or_refused(data):
    octets = bytearray(bsk_update())
    for _ in range(data.draw(st.integers(1, 4))):
        octets[data.draw(st.integers(0, len(octets) - 1))] = data.draw(st.integers(0, 255))
    try:
        seen = Update(bytes(octets))
        states = seen.spacecraft("seeker"), seen.body("eros")
        camera = seen.camera(1)
    except UpdateError:
        return
    for state in states:
        assert all(map(math.isfinite, (*state.position_m, *state.rotation)))
    assert all(map(math.isfinite, (*camera.position_m, *camera.direction)))


@pytest.mark.parametrize("t_ns", [math.nan, math.inf, -1.0, 2.0**54])
def test_a_time_that_cannot_be(t_ns):
    with pytest.raises(UpdateError, match="the update's time is"):
        Update(update(t_ns))


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "no currentTime"),
        (field(3, field(1, "seeker")), "no currentTime"),
        (b"\xff" * 40, "40 bytes are no VizMessage"),
        (bsk_update()[:-3], "are no VizMessage"),
        (field(1, b"\x0a" * 9), "are no VizMessage"),
        (update() + field(3, field(1, b"\xff\xfe")), "are no VizMessage"),  # a name that is no UTF-8
    ],
)
def test_what_is_no_update(data, why):
    with pytest.raises(UpdateError, match=why):
        Update(data)


def test_numbers_are_checked_where_they_are_asked_for():
    bad = [("nan", [math.nan, 0.0, 0.0], AT_REST), ("two", [0.0, 0.0], AT_REST), ("matrix", AT_REST, [1.0] * 9)]
    seen = Update(update(0, [*bad, ("good", AT_REST, AT_REST)], [("short", AT_REST, AT_REST)]))
    assert seen.spacecraft("good").position_m == (0.0, 0.0, 0.0)
    for name, why in (("nan", "all must be finite"), ("two", "has 2 numbers, 3"), ("matrix", "rotation has 9 numbers")):
        with pytest.raises(UpdateError, match=why):
            seen.spacecraft(name)
    with pytest.raises(UpdateError, match="rotation has 3 numbers, 9 are needed"):
        seen.body("short")


def test_a_name_that_is_not_there_is_told_with_those_that_are():
    many = [(f"craft{k}", AT_REST, AT_REST) for k in range(20)] + [("x" * 100_000, AT_REST, AT_REST)]
    seen = Update(update(0, many, cameras=[(3, "craft1", AT_REST, AT_REST)]))
    with pytest.raises(UpdateError, match=r"no spacecraft 'moth'.*'craft0', .*'craft7' and 13 more"):
        seen.spacecraft("moth")
    with pytest.raises(UpdateError, match="no camera 1 in the update; there are: 3"):
        seen.camera(1)
    with pytest.raises(UpdateError, match="there are: none"):
        seen.body("eros")
    with pytest.raises(UpdateError) as caught:
        seen.spacecraft("y" * 100_000)
    assert len(str(caught.value)) < 300


def test_a_camera_without_a_size_is_refused():
    data = update() + field(4, field(1, 2) + field(4, [346]) + field(7, AT_REST) + field(8, AT_REST))
    with pytest.raises(UpdateError, match="resolution has 1 numbers"):
        Update(data).camera(2)
