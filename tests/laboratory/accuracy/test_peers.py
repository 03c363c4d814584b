"""Other simulators on closed-form scenes: ideal pixels, files, the worker, its failures, scores and the page."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtri

from emulator.cli.app import _main
from laboratory.accuracy.peers import running, worker
from laboratory.accuracy.peers.page import BEGIN, END
from laboratory.accuracy.peers.running import BUNDLED, OURS, Adapter, run_adapter
from laboratory.accuracy.peers.scoring import read_events, score_events
from laboratory.accuracy.peers.sequences import SCENES, FolderError, export, open_folder
from laboratory.accuracy.scenes import Dark, Flash, MovingEdge, SlowRamp
from laboratory.accuracy.truth import ideal_events

DOCS = Path(__file__).parents[3] / "docs"
LIMIT_S = 60.0


def test_ideal_pixels_on_a_ramp_fire_at_the_whole_thresholds():
    ramp = SlowRamp(pixels=5, slowest=-3.0, fastest=3.0)
    found = ideal_events(ramp, 0.2, 0.3, 0.98)
    for pixel, speed in enumerate(np.linspace(-3, 3, 5)):
        threshold = 0.2 if speed > 0 else 0.3
        count = int(abs(speed) * 0.98 / threshold)
        expected = [] if speed == 0 else np.arange(1, count + 1) * threshold / abs(speed) * 1e6
        mine = found.pixel == pixel
        assert found.t_us[mine] == pytest.approx(expected, abs=1e-5)
        assert (found.on[mine] == (speed > 0)).all()


def test_ideal_pixels_at_an_edge_fire_where_its_formula_has_the_levels():
    edge = MovingEdge(pixels=7, sigma_px=0.5)
    found = ideal_events(edge, 0.2, 0.2, 0.4)
    levels = edge.dark * np.exp(0.2 * np.arange(1, 12))  # to 0.1 e^2.2 < 1
    z = ndtri((levels - edge.dark) / (edge.bright - edge.dark))
    for pixel, x in enumerate(np.linspace(-12, 12, 7)):
        expected = (z * edge.sigma_px + x) / edge.speed_px_s + edge.duration_s / 2
        assert found.t_us[found.pixel == pixel] == pytest.approx(expected * 1e6, abs=1e-5)
    assert found.on.all()


@pytest.mark.parametrize(
    ("scene", "thresholds", "words"),
    [(Flash(), (0.2, 0.2), "jumps"), (Dark(), (0.2, 0.2), "above 0"), (SlowRamp(), (0.0, 0.2), "thresholds")],
)
def test_light_without_ideal_events_is_refused(scene, thresholds, words):
    with pytest.raises(ValueError, match=words):
        ideal_events(scene, *thresholds, 0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("sequences")
    assert list(export(path, (1000,), ("edge", "ramp"))) == [
        "edge-1000",
        "ramp-1000",
        "busy-1000",
        "quiet-1000",
        "whole-1000",
    ]
    return open_folder(path)


def test_a_folder_of_sequences_has_frames_and_truth(folder):
    one = folder.sequences["edge-1000"]
    with np.load(folder.path / "edge-1000.npz") as stored:
        assert stored["light"].shape == stored["rate"].shape == (401, 12, 20) == (one.frames, one.height, one.width)
        row = SCENES["edge"].light.value(0.2)[0]
        assert stored["light"][200] == pytest.approx(row.reshape(12, 20), rel=1e-6)
        assert stored["t_ns"][-1] == 400_000_000
    assert set(folder.scored()) == {"edge-1000", "ramp-1000"}
    assert folder.truth("edge-1000").t_us == pytest.approx(ideal_events(SCENES["edge"].light, 0.2, 0.2, 0.4).t_us)


def test_a_folder_of_another_format_is_refused(folder, tmp_path):
    with pytest.raises(FolderError, match="evstim accuracy export"):
        open_folder(tmp_path)
    other = json.loads((folder.path / "sequences.json").read_text()) | {"format": 99}
    (tmp_path / "sequences.json").write_text(json.dumps(other))
    with pytest.raises(FolderError, match="format 99"):
        open_folder(tmp_path)


def example():
    """Return the adapter that the page shows."""
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "accuracy.md").read_text(), re.DOTALL)
    return next(block for block in blocks if "class Difference" in block)


def adapter_of(tmp_path, text, name="Peer"):
    file = tmp_path / "adapter.py"
    file.write_text(text)
    return Adapter(sys.executable, f"{file}:{name}")


def run(adapter, folder, out, names=("edge-1000", "ramp-1000"), limit_s=LIMIT_S):
    done = []
    outcome = run_adapter(adapter, folder.path, list(names), out, limit_s, done.append)
    assert sorted(done) == sorted(names)
    return outcome


def test_every_bundled_simulator_has_an_adapter():
    for name in (*BUNDLED, *OURS):
        made = worker.load_adapter(f"{running._ADAPTERS}:{name}")
        assert callable(made.step)
        assert made.name


@pytest.mark.system
def test_the_example_of_the_page_beside_ours(folder, tmp_path):
    """The peer of CI: it dates events by the next frame, ours are a thousand times closer on the same frames."""
    outcome = run(adapter_of(tmp_path, example(), "Difference"), folder, tmp_path, tuple(folder.sequences))
    assert outcome.failures == {}
    assert outcome.about["name"] == "difference"
    scores, times, remarks = score_events(folder, tmp_path, {})
    ramp = next(one for one in scores if one.scene == "ramp")
    assert ramp.right == 1
    assert ramp.t50_us == pytest.approx(500, rel=0.1)  # the time to the next frame, of 1000 us
    assert ramp.t95_us == pytest.approx(950, rel=0.05)
    assert remarks == ()
    assert times["busy-1000"].pixels == 346 * 260
    assert times["busy-1000"].cpu_us > 0
    assert "whole-1000" not in times
    for ours in OURS:
        names = ("edge-1000", "ramp-1000", "whole-1000")
        assert run(Adapter.bundled(ours, sys.executable), folder, tmp_path, names).failures == {}
        edge, ramp = score_events(folder, tmp_path, {})[0]
        assert edge.right == ramp.right == 1
        assert edge.false == edge.missed == 0
        assert edge.t50_us < (12 if ours == "evstim_line" else 0.1)


BAD = {
    "raises": ("raise KeyError('no colour')", "KeyError: 'no colour'"),
    "crashes": ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "ended by SIGSEGV"),
    "exits": ("import os, sys; print('out of patience', file=sys.stderr, flush=True); os._exit(7)", "code 7: out of"),
    "nan": ("return [np.nan], [1], [1], [True]", "not finite"),
    "uneven": ("return [1.0, 2.0], [1], [1], [True]", "one length"),
    "outside": ("return [1.0], [20], [3], [True]", r"outside 20 x 12 pixels, one at \(20, 3\)"),
}
PEER = """
import numpy as np

class Peer:
    name = "peer"

    def __init__(self, settings):
        self.bad = settings.scene == "edge"

    def step(self, frame):
        print("a simulator that prints", frame.t_ns)
        if self.bad:
            {}
        return [], [], [], []
"""


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("how", BAD)
def test_a_simulator_that_fails_is_reported_and_the_run_goes_on(how, folder, tmp_path):
    action, reason = BAD[how]
    outcome = run(adapter_of(tmp_path, PEER.format(action)), folder, tmp_path)
    edge, ramp = score_events(folder, tmp_path, outcome.failures)[0]
    assert re.search(reason, edge.failure)
    assert ramp.failure == ""
    assert ramp.missed == 1


@pytest.mark.system
def test_a_simulator_that_does_not_end_is_stopped(folder, tmp_path):
    adapter = adapter_of(tmp_path, PEER.format("import threading; threading.Event().wait()"))
    assert run(adapter, folder, tmp_path, limit_s=5.0).failures == {"edge-1000": "no end after 5 s"}
    assert read_events(tmp_path, "ramp-1000").t_us.size == 0


class Film:
    """A simulator that returns everything at the end."""

    def step(self, frame):
        return None

    def finish(self):
        return [1.0, 2.0], [0, 1], [0, 0], [1, -1]


def test_a_simulator_of_whole_films_returns_its_events_at_the_end():
    found = worker.run_sequence(Film(), (worker.Frame(k, np.ones((2, 2)), None) for k in range(4)))
    assert found["t_us"].tolist() == [1, 2]
    assert found["on"].tolist() == [True, False]
    assert found["frame"].tolist() == [4, 4]
    assert found["cpu_ns"].size == 4


def events_of(folder, name, **changed):
    truth, one = folder.truth(name), folder.sequences[name]
    columns = {"t_us": truth.t_us, "x": truth.pixel % one.width, "y": truth.pixel // one.width, "on": truth.on}
    return columns | changed


def test_the_truth_itself_has_no_errors_and_remarks_name_bad_times(folder, tmp_path):
    for name in folder.scored():
        np.savez(tmp_path / f"{name}.npz", **events_of(folder, name))
    scores, times, remarks = score_events(folder, tmp_path, {})
    assert [(one.right, one.t95_us, one.false, one.missed) for one in scores] == [(1, 0, 0, 0)] * 2
    assert times == {}
    assert remarks == ()
    columns = events_of(folder, "edge-1000")
    frame = (columns["t_us"] // 1000 + 1).astype(int)
    columns["t_us"] = columns["t_us"] + np.where(np.arange(frame.size) % 50 == 0, 5000, 0)
    last_first = np.argsort(-columns["t_us"], kind="stable")
    columns = {n: part[last_first] for n, part in columns.items()}
    np.savez(tmp_path / "edge-1000.npz", **columns, frame=frame[last_first])
    _, _, remarks = score_events(folder, tmp_path, {})
    assert re.search(
        r"^\d\.\d+ % of the events have times outside the step of their frame, by up to \d{4} us", remarks[0]
    )
    assert remarks[1] == "events of a frame are not in order of time"


def test_false_and_missed_events_are_counted_apart(folder, tmp_path):
    columns = events_of(folder, "ramp-1000")
    keep = np.arange(columns["t_us"].size) % 10 != 0
    extra = {"t_us": [7e5] * 30, "x": [3] * 30, "y": [3] * 30, "on": [False] * 30}
    np.savez(tmp_path / "ramp-1000.npz", **{n: np.concatenate([part[keep], extra[n]]) for n, part in columns.items()})
    ramp = score_events(folder, tmp_path, {"edge-1000": "not run"})[0][1]
    assert ramp.missed * ramp.true_events == pytest.approx((~keep).sum())
    assert ramp.false * ramp.true_events == pytest.approx(30)


def test_a_table_of_text_is_read_with_and_without_a_heading(tmp_path):
    for name, heading in (("a", "t_us,x,y,on\n"), ("b", "")):
        (tmp_path / f"{name}.csv").write_text(heading + "1.5,2,3,1\n1e3,0,1,-1\n")
        found = read_events(tmp_path, name)
        assert found.t_us.tolist() == [1.5, 1000]
        assert (found.x.tolist(), found.y.tolist(), found.on.tolist()) == ([2, 0], [3, 1], [True, False])
    (tmp_path / "c.csv").write_text("")
    assert read_events(tmp_path, "c").t_us.size == 0


@pytest.mark.system
def test_the_verbs_export_score_and_peers(folder, tmp_path, capsys):
    quick = ["--scene", "edge", "--images-per-s", "1000"]
    assert _main(["accuracy", "export", str(tmp_path / "s"), *quick]) == 0
    columns = events_of(folder, "edge-1000")
    (tmp_path / "e").mkdir()
    np.savez(tmp_path / "e" / "edge-1000.npz", **columns)
    mine = ["--name", "mine, by files", "--out", str(tmp_path / "o")]
    assert _main(["accuracy", "score", str(tmp_path / "s"), str(tmp_path / "e"), *mine]) == 0
    assert "100.0 % right" in capsys.readouterr().out
    (tmp_path / "difference.py").write_text(example())
    page = tmp_path / "page.md"
    page.write_text(f"# Page\n{BEGIN}\n{END}\nEnd\n")
    command = [
        "accuracy",
        "peers",
        "--out",
        str(tmp_path / "o"),
        "--adapter",
        str(tmp_path / "difference.py:Difference"),
    ]
    assert _main([*command, *quick, "--page", str(page), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["simulators"]["difference"][0]["right"] == 1
    assert "|mine, by files|1000|" in page.read_text()
    assert (tmp_path / "pictures" / "simulators.png").stat().st_size
    assert _main(["accuracy", "score", str(tmp_path / "s"), str(tmp_path / "none")]) == 1
    assert "there is no edge-1000.npz" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("peers --out {} --simulator v2f", "there is evstim"),
        ("peers --out {} --simulator v2e", "path of its checkout"),
        ("peers --out {} --simulator v2e=/no/such/place", "there is no /no"),
        ("peers --out {} --adapter none.py:Peer", "FILE.py:MAKE"),
        ("peers --out {} --python /no/python", "no such program"),
        ("peers --out {} --page README.md", "has no line"),
        ("peers --out {} --scene desert", "there is edge"),
        ("export {} --images-per-s 7", "whole number of frames"),
        ("score {} {}", "evstim accuracy export"),
    ],
)
def test_wrong_use_of_the_verbs(arguments, words, tmp_path, capsys):
    assert _main(["accuracy", *arguments.format(tmp_path, tmp_path).split()]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
