"""Damaged SPICE kernels of each kind: the path is refused with the kernel's name, or sound, within a bound of time.

Thirty by default, of all kinds in turns; `EVSTIM_HOSTILE_FILES` and `EVSTIM_HOSTILE_SEED` as in `test_files`.
"""

import random

import numpy as np
import pytest

from emulator.trajectory.building import build_trajectory
from emulator.trajectory.parameters import SpicePath
from emulator.trajectory.pose import TrajectoryError
from tests.emulator.trajectory.test_spice import LSK, SCLK, SPIN_FK
from tests.forked_reader import Fork
from tests.hostile.mutation import damaged_bytes, damaged_text
from tests.hostile.test_files import COUNT, MOST_S, SEED, spent_s
from transports import guarded_reader

spice = pytest.importorskip("spiceypy", reason="needs the extra `spice`")

PCK = """KPL/PCK
\\begindata
BODY2000433_POLE_RA = ( 11.35 0.01 0. )
BODY2000433_POLE_DEC = ( 17.22 0. 0. )
BODY2000433_PM = ( 326.07 1639.38864745 0. )
\\begintext
"""
START_UTC, START_S = "2020-01-01T12:00:00", 631152069.184  # within a millisecond
EARTH_FRAME = 3000  # class number of ITRF93


def write_kernels(folder):
    """Write a fly-by, a spinning camera, and the turns of Eros and of the Earth."""
    for name, text in (("leap.tls", LSK), ("clock.tsc", SCLK), ("spin.tf", SPIN_FK), ("eros.tpc", PCK)):
        (folder / name).write_text(text)
    ets = START_S + np.arange(-100.0, 401.0, 100.0)
    span = ets[0], ets[-1]
    spk = spice.spkopn(str(folder / "places.bsp"), "made", 0)
    states = [[-1000.0 + 6 * (et - START_S), 200, 50, 6, 0, 0] for et in ets]
    spice.spkw13(spk, -900, 10, "J2000", *span, "fly-by", 3, len(ets), states, ets)
    spice.spkcls(spk)
    ck = spice.ckopn(str(folder / "spin.bc"), "made", 0)
    ticks = (ets - 6.3e8) * 65536  # see SCLK
    turns = [spice.m2q(spice.rotate(0.02 * (et - START_S), 3)) for et in ets]
    rates = [[0, 0, 0.02]] * len(ets)
    camera = -900000, "J2000", True, "spin"
    spice.ckw03(ck, ticks[0], ticks[-1], *camera, len(ets), ticks, turns, rates, 1, ticks[:1])
    spice.ckcls(ck)
    pck = spice.pckopn(str(folder / "earth.bpc"), "made", 0)
    angles = [0.1, 0, 0.5, 0, 1.0, 7.3e-3]  # two coefficients of each, over 500 s
    spice.pckw02(pck, EARTH_FRAME, "ECLIPJ2000", *span, "earth", 500.0, 1, 1, angles, span[0])
    spice.pckcls(pck)


USES = {  # the kernel that is damaged, the frame of the world in which it counts
    "places.bsp": "J2000",
    "spin.bc": "J2000",
    "eros.tpc": "IAU_EROS",
    "earth.bpc": "ITRF93",
    "leap.tls": "J2000",
    "clock.tsc": "J2000",
    "spin.tf": "J2000",
}


@pytest.mark.long
@pytest.mark.system
def test_a_damaged_kernel_is_refused_by_name_or_read(tmp_path, monkeypatch):
    monkeypatch.setattr(guarded_reader, "_start", Fork)
    write_kernels(tmp_path)
    good = {name: (tmp_path / name).read_bytes() for name in USES}
    kernels = tuple(str(tmp_path / name) for name in USES)

    def sound_path(frame):
        path = build_trajectory(SpicePath(kernels, "-900", "SUN", frame, "SPINCAM", START_UTC, duration_s=300.0))
        for t_ns in (0, 10**11, 3 * 10**11):
            assert np.isfinite(path.pose(t_ns).position_m).all()
        assert path.bounds.speed_m_s >= 0

    for frame in set(USES.values()):
        sound_path(frame)
    refused = 0
    for n in range(COUNT):
        name = list(USES)[n % len(USES)]
        rng, damage = random.Random(f"{SEED} {name} {n}"), damaged_bytes if "b" in name[-3:] else damaged_text
        (tmp_path / name).write_bytes(damage(good[name], rng))
        start_s, message = spent_s(), name
        try:
            sound_path(USES[name])
        except TrajectoryError as error:
            message = str(error)
            refused += 1
        except BaseException as error:
            error.add_note(f"mutation {n} of {name}")
            raise
        assert name in message, (n, message)
        assert len(message) < 3000, (n, message)
        assert spent_s() - start_s < MOST_S, (n, name)
        (tmp_path / name).write_bytes(good[name])
    assert refused > COUNT // 4
