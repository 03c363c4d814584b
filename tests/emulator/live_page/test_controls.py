"""The menu of faults has a sentence for each; what can be undone is undone once, whoever wants it."""

import json
import math

import pytest

from emulator.live_page.controls import Repeats, fault_menu, totals
from emulator.live_page.messages import ViewerCommands
from emulator.run.changes import Change, Changes
from emulator.run.outcome import Ledger, RunResult, RunStatus
from emulator.run.pacing import Lateness
from transports.faults.kinds import FAULTS
from transports.faults.script import FaultRecord
from transports.link.report import LinkReport


class Session:
    """A session that records changes as the real one does."""

    stopping = False

    def stop(self):
        self.stopping = True

    def __init__(self):
        self.adjustable = {"threshold_on": 0.3, "leak_hz": 1.0}
        self.recorded = Changes()
        self.t_ns = 0

    @property
    def changes(self):
        return self.recorded.in_order

    def thresholds_of(self, x, y):
        if x > 1:
            raise ValueError(f"there is no pixel ({x}, {y})")
        return (math.inf, math.inf) if x else (0.25, 0.375)

    def adjust(self, name, value, by):
        before = self.adjustable[name]
        self.adjustable[name] = value
        self.recorded.add(Change(self.t_ns, by, name, before=before, after=value))


def _commands(session, *links):
    ended = []

    def inject(message, _):
        assert message["request"] == "end"
        ended.append((message["link"], message["number"]))
        return {"link": message["link"], "kind": "stall"}

    commands = ViewerCommands(session, inject)
    commands.status = RunStatus(1.0, 1.0, 1, 1, Lateness(), {name: LinkReport("open", faults=f) for name, f in links})
    return commands, ended


def _undo(commands, number):
    return commands.carry_out({"do": "undo", "change": number})


def test_each_fault_has_a_sentence_and_its_keys_can_be_sent():
    menu = fault_menu(FAULTS)
    assert len(menu) > 30
    for kind, entry in menu.items():
        assert entry["text"].endswith("."), kind
        assert len(entry["text"]) < 200, kind
        assert not {"link", "at_s"} & set(entry["keys"])
    json.dumps(menu, allow_nan=False)
    apart = {kind for kind, entry in menu.items() if entry["disconnects"]}
    assert apart == {"unplugged", "usb_unplugged", "link_down", "lost_heartbeat", "ip_change"}
    assert menu["stuck_line"]["keys"]["level"] == {"default": "low", "choices": ["low", "high"]}


@pytest.mark.parametrize(("x", "answer"), [(0, [0.25, 0.375]), (1, []), (2, None)])
def test_a_pixel_has_its_thresholds_and_a_dead_one_has_none(x, answer):
    commands, _ = _commands(Session())
    assert commands.carry_out({"do": "pixel", "x": x, "y": 5}) == {"pixel": [x, 5], "thresholds": answer}


def test_steps_of_a_slider_are_one_row_that_is_undone_once():
    session = Session()
    commands, _ = _commands(session)
    for value in (0.28, 0.25, 0.2):
        session.t_ns += 100_000_000
        commands.carry_out({"do": "adjust", "name": "threshold_on", "value": value})
    (row,) = commands.state()["changes"]
    assert (row["number"], row["before"], row["after"], row["cannot"]) == (0, 0.3, 0.2, "")
    assert "did" in _undo(commands, 0)
    assert session.adjustable["threshold_on"] == 0.3
    assert session.changes[-1].by == "live page, undo"
    again = _undo(commands, 0)  # another page
    assert "set back" in again["error"]
    assert len(session.changes) == 4


def test_a_later_change_of_the_same_parameter_stands_before_an_undo():
    session = Session()
    commands, _ = _commands(session)
    for t_ns, name, value in ((0, "threshold_on", 0.2), (0, "leak_hz", 2.0), (5_000_000_000, "threshold_on", 0.1)):
        session.t_ns = t_ns
        commands.carry_out({"do": "adjust", "name": name, "value": value})
    assert "changed again at 5.000 s" in _undo(commands, 0)["error"]
    _undo(commands, 1)
    _undo(commands, 2)
    assert session.adjustable == {"threshold_on": 0.2, "leak_hz": 1.0}


@pytest.mark.parametrize(
    ("change", "record", "reason"),
    [
        (Change(0, "live page", "fault stall", "a", taken_us=9, fault=1), FaultRecord(1, "stall", 5), ""),
        (Change(0, "live page", "fault stall", "a", taken_us=9, fault=1), FaultRecord(1, "stall", 5, 2_000_000), "2.0"),
        (Change(0, "live page", "fault stall", "a", taken_us=9, fault=1), FaultRecord(1, "stall", 10), "again"),
        (Change(0, "live page", "fault unplugged", "a", taken_us=9, fault=1), FaultRecord(1, "unplugged", 5), "host"),
        (Change(0, "live page", "end of fault stall", "a", taken_us=9, fault=1), FaultRecord(1, "stall", 5), "inject"),
        (Change(0, "live page", "trigger pulse"), None, "received"),
        (Change(0, "register", "threshold_on", "a", 0.3, 0.2), None, "host"),
    ],
)
def test_what_cannot_be_undone_has_its_reason(change, record, reason):
    session = Session()
    session.recorded.add(change)
    commands, ended = _commands(session, ("a", () if record is None else (record,)))
    (row,) = commands.state()["changes"]
    assert (reason in row["cannot"]) if reason else row["cannot"] == ""
    assert ("error" in _undo(commands, 0)) == bool(reason)
    assert ended == ([] if reason else [("a", 1)])
    assert len(session.changes) == 1


def _again(commands, seed):
    return commands.carry_out({"do": "again", "seed": seed})


def test_a_run_starts_again_with_one_seed_whoever_else_sends_one():
    session, repeats = Session(), Repeats()
    commands = ViewerCommands(session, lambda *_: {}, repeats=repeats)
    for seed in (-1, 2**63, 10**400):
        assert "seed must be" in _again(commands, seed)["error"]
    assert not session.stopping
    assert "did" in _again(commands, 7)
    assert session.stopping
    assert "starting already" in _again(commands, 8)["error"]
    assert commands.state()["next_seed"] == 7


def test_a_run_whose_files_would_be_written_over_is_not_started_again():
    session, repeats = Session(), Repeats("--record")
    assert "--record" in _again(ViewerCommands(session, lambda *_: {}, repeats=repeats), 7)["error"]
    assert not session.stopping
    assert repeats.take(None, None) is None


def test_a_signal_ends_the_run_for_good():
    repeats = Repeats()
    repeats.request(7)
    repeats.cancel()
    assert repeats.take(None, None) is None
    with pytest.raises(ValueError, match="it ends"):
        repeats.request(8)


def test_a_run_that_goes_on_has_the_totals_of_one_that_has_ended():
    links = {"a": LinkReport("open", delivered=5, dropped=2)}
    status = RunStatus(2.0, 2.0, 3, 7, Lateness(), links, raised=9)
    result = RunResult(2.0, 2.0, 3, 3, Ledger(9, 1, 1, 7), Lateness(), links)
    assert totals(status) == totals(result)
    assert totals(result)["links"]["a"] == {"delivered": 5, "dropped": 2, "p50": None, "p99": None}
