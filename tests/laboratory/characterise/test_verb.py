"""`evstim characterise`: options that need a recording are refused without one."""

import pytest

from emulator.cli.app import _main


@pytest.mark.parametrize(
    ("options", "named"),
    [(["--still", "0"], "--still"), (["--light", "0"], "--light"), (["--fit", "--light", "1"], "--light and --fit")],
)
def test_options_without_effect_are_refused(options, named, tmp_path, capsys):
    assert _main(["characterise", "davis346", "--out", str(tmp_path / "out"), *options]) == 2
    assert f"{named}: only beside a recording: name it by --recording" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
