"""FMUs that were built by gcc: beside the closed form of a fall, and where they fail."""

import zipfile

import pytest

from emulator.dynamics import fmu
from emulator.dynamics.failures import DynamicsError, FlightEnded
from emulator.dynamics.fmu import Fmu
from emulator.dynamics.mapping import Mapping

pytestmark = pytest.mark.system

FALL = Mapping(position_m=(0.0, 0.0, "height_m"), step_s=0.01, start={"speed_m_s": -2.0})


@pytest.mark.parametrize("version", [2, 3])
def test_a_body_falls_as_the_closed_form_says(falling, version):
    with Fmu(falling(version), FALL, ("thrust_m_s2",)) as unit:
        assert unit.outputs == {"height_m": 100.0}
        for k in range(1000):
            unit.step(k * 0.01, 0.01, {"thrust_m_s2": 3.0} if k == 500 else {})
        fall_5_s = 100 - 2 * 5 - 1.62 * 5**2 / 2
        speed = -2 - 1.62 * 5
        assert unit.outputs["height_m"] == pytest.approx(fall_5_s + speed * 5 + (3 - 1.62) * 5**2 / 2, abs=1e-9)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(
    ("trouble", "told"), [(1, r"crashed in its step from 0\.5 s \(SIGSEGV"), (3, "failed in its step")]
)
def test_an_fmu_that_fails_in_flight(falling, version, trouble, told):
    with Fmu(falling(version), FALL, ("trouble",)) as unit:
        unit.step(0.0, 0.5, {})
        with pytest.raises(FlightEnded, match=told):
            unit.step(0.5, 0.5, {"trouble": float(trouble)})


def test_an_fmu_that_hangs(falling, monkeypatch):
    monkeypatch.setattr(fmu, "_STEP_S", 0.5)
    with (
        Fmu(falling(2), FALL, ("trouble",)) as unit,
        pytest.raises(FlightEnded, match=r"does not answer within 0\.5 s"),
    ):
        unit.step(0.0, 0.5, {"trouble": 4.0})
    assert unit._process.exitcode is not None


@pytest.mark.parametrize(
    ("outputs", "told"),
    [("speed", "has no variable 'speed'; it has height_m"), ("count", "has 'count' as Integer: .* must be Real")],
)
def test_variables_that_cannot_be_used(falling, outputs, told):
    with pytest.raises(DynamicsError, match=told):
        Fmu(falling(2), Mapping(position_m=(0.0, 0.0, outputs)))


def test_files_that_are_no_fmu(falling, tmp_path):
    text, empty = tmp_path / "text.fmu", tmp_path / "empty.fmu"
    text.write_text("no")
    with zipfile.ZipFile(empty, "w") as archive:
        archive.writestr("readme", "no")
    for file, told in ((text, "is not an FMU"), (empty, "is not a valid FMU"), (tmp_path / "none", "no such file")):
        with pytest.raises(DynamicsError, match=told):
            Fmu(file, FALL)


def test_machine_code_of_another_platform(falling, tmp_path):
    other = tmp_path / "other.fmu"
    with zipfile.ZipFile(falling(2)) as one, zipfile.ZipFile(other, "w") as archive:
        archive.writestr("modelDescription.xml", one.read("modelDescription.xml"))
        archive.writestr("binaries/win64/falling.dll", b"")
    with pytest.raises(DynamicsError, match=r"has no machine code for .*, only for win64"):
        Fmu(other, FALL)
