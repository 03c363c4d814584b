"""FMUs that were built by gcc: beside the closed form of a fall, and where they fail."""

import shutil
import struct
import tempfile
import zipfile

import pytest

from emulator.dynamics import flight
from emulator.dynamics.flight import DynamicsError, FlightEnded, Fmu, Mapping

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
def test_an_fmu_that_fails_in_flight(falling, version, trouble, told, unpacked):
    with Fmu(falling(version), FALL, ("trouble",)) as unit:
        unit.step(0.0, 0.5, {})
        with pytest.raises(FlightEnded, match=told):
            unit.step(0.5, 0.5, {"trouble": float(trouble)})
    assert not list(unpacked.iterdir())


def test_an_fmu_that_hangs(falling, monkeypatch, unpacked):
    monkeypatch.setattr(flight, "_STEP_S", 0.5)
    with (
        Fmu(falling(2), FALL, ("trouble",)) as unit,
        pytest.raises(FlightEnded, match=r"does not answer within 0\.5 s"),
    ):
        unit.step(0.0, 0.5, {"trouble": 4.0})
    assert unit._process.exitcode is not None
    assert not list(unpacked.iterdir())


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


MIB = 1 << 20


def with_entry(original, file, name, mib):
    """Copy an FMU, with another entry of so many MiB of zeros, which take a thousandth of that."""
    with zipfile.ZipFile(original) as one, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for other in one.namelist():
            if other != name:
                archive.writestr(other, one.read(other))
        with archive.open(name, "w", force_zip64=True) as entry:
            for _ in range(mib):
                entry.write(bytes(MIB))
    return file


@pytest.fixture
def unpacked(tmp_path, monkeypatch):
    """The folder that takes all temporary files of the test's processes."""
    (tmp_path / "unpacked").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "unpacked"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path / "unpacked"


@pytest.mark.parametrize(
    ("name", "mib", "told"),
    [
        ("resources/zeros", 1025, r"unpacks to 1025 MiB: at most 1024 MiB are unpacked\. Export it without sources"),
        ("modelDescription.xml", 65, r"has a modelDescription\.xml of 65 MiB: at most 64 MiB"),
    ],
)
def test_an_archive_that_unpacks_to_a_bomb_is_refused(falling, tmp_path, unpacked, name, mib, told):
    bomb = with_entry(falling(2), tmp_path / "bomb.fmu", name, mib)
    assert bomb.stat().st_size < 8 * MIB
    with pytest.raises(DynamicsError, match=told):
        Fmu(bomb, FALL)
    assert sum(path.stat().st_size for path in unpacked.rglob("*") if path.is_file()) == 0


def test_an_archive_of_too_many_files_is_refused(falling, tmp_path):
    many = tmp_path / "many.fmu"
    shutil.copy(falling(2), many)
    with zipfile.ZipFile(many, "a") as archive:
        for k in range(10_001):
            archive.writestr(f"resources/{k}", b"")
    with pytest.raises(DynamicsError, match=r"has 100\d\d files: at most 10000 are unpacked"):
        Fmu(many, FALL)


def test_an_archive_that_lies_about_its_sizes_is_unpacked_no_further_than_it_says(falling, tmp_path, unpacked):
    """Both headers of the entry say 5 bytes; its data are those of 20 MiB."""
    liar = with_entry(falling(2), tmp_path / "liar.fmu", "resources/zeros", 20)
    data = liar.read_bytes().replace(struct.pack("<Q", 20 * MIB), struct.pack("<Q", 5))
    liar.write_bytes(data.replace(struct.pack("<L", 20 * MIB), struct.pack("<L", 5)))
    with zipfile.ZipFile(liar) as archive:
        assert archive.getinfo("resources/zeros").file_size == 5
    with pytest.raises(DynamicsError, match="is damaged: "):
        Fmu(liar, FALL)
    assert not [path for path in unpacked.rglob("zeros") if path.stat().st_size > MIB]


def test_the_archive_of_a_large_model_is_taken(falling, tmp_path, unpacked):
    large = with_entry(falling(2), tmp_path / "large.fmu", "resources/table", 40)
    with Fmu(large, FALL) as unit:
        assert unit.outputs == {"height_m": 100.0}
        (table,) = unpacked.rglob("table")
        assert table.stat().st_size == 40 * MIB
    assert not list(unpacked.rglob("table"))
