"""Signals that stop a command: which of them end a run, which interrupt it, and which do nothing."""

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from emulator.cli.app import _main
from emulator.cli.signals import StopSignals, ignore_stop_signals, interrupt_on_stop_signals, stop_on_signals

EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()"]
NUMBERS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
RIG = """
[scene]
kind = "checkerboard"
speed_px_s = 20.0
[camera.sensor]
width = 64
height = 48
[run]
step_us = 2000
max_late_ms = 0
[[links]]
kind = "loopback"
"""


class Stopped:
    """What a signal calls, and the time that the handler reads."""

    def __init__(self):
        self.count = 0
        self.now_s = 100.0
        self.signals = StopSignals(self.stop, lambda: self.now_s)

    def stop(self):
        self.count += 1


def interrupts(act, *arguments):
    """Return whether this raises KeyboardInterrupt, which would end the tests."""
    try:
        act(*arguments)
    except KeyboardInterrupt:
        return True
    return False


def test_a_second_signal_soon_after_the_first_does_nothing():
    stopped = Stopped()
    assert not interrupts(stopped.signals)
    stopped.now_s += 0.2
    assert not interrupts(stopped.signals)
    assert stopped.count == 1


def test_a_third_signal_interrupts():
    stopped = Stopped()
    assert [interrupts(stopped.signals) for _ in range(4)] == [False, False, True, True]
    assert stopped.count == 1


def test_a_second_signal_after_some_seconds_interrupts():
    stopped = Stopped()
    assert not interrupts(stopped.signals)
    stopped.now_s += 10.0
    assert interrupts(stopped.signals)


@pytest.mark.parametrize("pair", list(itertools.product(NUMBERS, NUMBERS)))
def test_two_signals_of_any_kind_stop_once(pair):
    stops = []
    stop_on_signals(lambda: stops.append(1))
    assert not any([interrupts(signal.raise_signal, number) for number in pair])
    assert stops == [1]


def test_before_a_run_the_first_signal_interrupts_and_the_second_disturbs_no_message():
    interrupt_on_stop_signals()
    assert [interrupts(signal.raise_signal, signal.SIGTERM) for _ in range(2)] == [True, False]


@pytest.mark.parametrize("number", NUMBERS)
def test_a_signal_ends_a_step_though_its_handler_waits_for_a_compiled_loop(number):
    """Another thread calls the function: Python runs no handler before the main thread is back from a loop."""
    ended = threading.Event()
    stop_on_signals(lambda: None, end_step=ended.set)
    try:
        signal.raise_signal(number)
        assert ended.wait(60)
    finally:
        os.close(signal.set_wakeup_fd(-1))


@pytest.mark.parametrize("number", NUMBERS)
def test_while_the_summary_is_written_signals_do_nothing(number):
    stop_on_signals(lambda: None)
    ignore_stop_signals()
    assert not any([interrupts(signal.raise_signal, number) for _ in range(5)])


def test_an_interrupted_command_says_so_with_the_exit_code_of_the_rules(monkeypatch, capsys):
    def interrupted(_):
        interrupt_on_stop_signals()
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("emulator.cli.rigs.load_rig", interrupted)
    assert _main(["check", "loopback", "--json"]) == 1
    told = capsys.readouterr()
    assert json.loads(told.out.splitlines()[-1]) == {"error": "interrupted", "exit_code": 1}
    assert "evstim: interrupted" in told.err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_an_interpreter_that_ends_does_nothing(number):
    """The object is deleted when the interpreter has given up its handlers."""
    program = f"""
import os, sys
from emulator.cli.signals import ignore_stop_signals
class Late:
    def __init__(self, kill, process):
        self.kill, self.process = kill, process
    def __del__(self):
        self.kill(self.process, {int(number)})
ignore_stop_signals()
late = Late(os.kill, os.getpid())
sys.exit(4)
"""
    assert subprocess.run([sys.executable, "-c", program], check=False, timeout=300).returncode == 4


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("gap_s", [0.02, 0.2])
@pytest.mark.parametrize(
    ("send", "number"), [(os.kill, signal.SIGINT), (os.killpg, signal.SIGINT), (os.killpg, signal.SIGTERM)]
)
def test_a_stop_that_arrives_twice_ends_with_the_summary(send, number, gap_s, tmp_path):
    rig, report = tmp_path / "small.toml", tmp_path / "report"
    rig.write_text(RIG)
    command = [*EVSTIM, "run", str(rig), "--report", str(report), "--record", str(tmp_path / "a.aedat4")]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    while "real time" not in process.stderr.readline():  # the line of a run that has begun
        assert process.poll() is None
    send(process.pid, number)
    time.sleep(gap_s)  # of a wrapper that forwards the signal: the second arrives at any moment of the end
    send(process.pid, number)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert "ledger: balanced" in out
    assert "Traceback" not in err
    assert (report / "report.html").exists()
