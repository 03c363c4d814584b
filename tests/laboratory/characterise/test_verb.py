"""`evstim characterise --recording`: its columns have a header, and options that need it are refused without."""

import pytest

from emulator.cli.app import _main
from laboratory.characterise.recordings import Compared
from laboratory.verbs import characterise


class Fixed:
    """Statistics of a stream."""

    events = 3

    def __init__(self, value):
        self.value = value

    def figures(self):
        return {"rate, Hz": self.value, "ON share": 0.5}


@pytest.mark.parametrize("name", ["a.raw", "a_recording_with_a_long_name[1].aedat4"])
def test_each_column_has_its_name_above(monkeypatch, capsys, name):
    monkeypatch.setattr("laboratory.characterise.recordings.distances", lambda *_: {"rate, ratio": 2.0})
    comparison = Compared({name: Fixed(1.25), "davis346": Fixed(2.5)}, None, ["A sentence."])
    characterise._show(comparison, "davis346", "a.raw", [], json=False)
    lines = capsys.readouterr().out.splitlines()
    header, rate = lines[1], lines[2]
    assert header.split() == ["statistic", name, "davis346"]
    assert rate.startswith("rate, Hz")
    assert rate[: header.index(name) + len(name)].endswith("1.25")
    assert rate[: header.index("davis346") + len("davis346")].endswith("2.5")
    assert {len(line) for line in lines[1:]} == {len(header)}


@pytest.mark.parametrize(
    ("options", "named"),
    [(["--still", "0"], "--still"), (["--light", "0"], "--light"), (["--fit", "--light", "1"], "--light and --fit")],
)
def test_options_without_effect_are_refused(options, named, tmp_path, capsys):
    assert _main(["characterise", "davis346", "--out", str(tmp_path / "out"), *options]) == 2
    assert f"{named}: only beside a recording: name it by --recording" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
