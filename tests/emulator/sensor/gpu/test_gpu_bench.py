"""That the benches of the card do what they say."""

import pytest

from emulator.cli.bench import bench
from emulator.evaluation.bench import gpu
from emulator.evaluation.bench.gpu import Drawing, PixelSteps, Reading
from emulator.evaluation.bench.measures import MEASURES


@pytest.fixture
def _briefly(gl, monkeypatch):
    monkeypatch.setattr(gpu, "_SECONDS", 0.01)


@pytest.mark.gl
@pytest.mark.usefixtures("_briefly")
def test_each_takes_some_time():
    for run in (Drawing((32, 24), with_rate=True), Reading((32, 24), "direct"), Reading((32, 24), "ring")):
        assert 0 < run() < 1e4


@pytest.mark.gl
@pytest.mark.usefixtures("_briefly")
@pytest.mark.parametrize("on_card", [True, False])
def test_pixels_fire_as_they_should(on_card, monkeypatch):
    monkeypatch.setattr(gpu, "_LEAST", gpu._TURN)
    assert PixelSteps((64, 48), fires=True, on_card=on_card).run()[1] == pytest.approx(0.2, rel=0.1)
    assert PixelSteps((64, 48), fires=False, on_card=on_card).run()[1] == 0


def test_a_pattern_chooses_all_that_match(monkeypatch, capsys):
    monkeypatch.setattr("emulator.cli.bench.MEASURES", [m for m in MEASURES if m.name.startswith(("gpu_p", "words"))])
    monkeypatch.setattr("emulator.cli.bench._value", lambda measure: 1.0)
    assert bench(only=["gpu_*", "words_encode"]) == 0
    told = capsys.readouterr().out
    assert told.count("gpu_pixels_") == 8
    assert "words_encode" in told
    assert "words_decode" not in told
