"""Signals that stop a command: which of them end a run, which interrupt it, and which do nothing."""

import itertools
import json
import os
import random
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
    ignore_stop_signals()


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


BEFORE_A_RUN = """
import ctypes, pickle, signal, threading
from emulator.cli.signals import interrupt_on_stop_signals, stop_on_signals
from numba.core.serialize import _numba_unpickle
import llvmlite.binding as llvm

def send():
    signal.raise_signal(signal.SIGINT)

class Sends:
    def __reduce__(self):
        return send, ()

def compile_with_llvm(notify):
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly("define i32 @f() {{ ret i32 1 }}")
    engine = llvm.create_mcjit_compiler(module, llvm.Target.from_default_triple().create_target_machine())
    engine.set_object_cache(notify, lambda module: None)
    engine.finalize_object()

interrupt_on_stop_signals()
try:
    {act}
    print("returned")
    {then}
except KeyboardInterrupt:
    print("interrupted")
"""
IN_A_CALLBACK = "ctypes.CFUNCTYPE(None)(lambda: (send(), print('lost')))()"
IN_LLVM = "compile_with_llvm(lambda module, code: (send(), print('stored')))"
IN_A_RESULT = "_numba_unpickle(1, pickle.dumps(Sends()), b''); print('made')"
IN_AN_IMPORT = "import sends"


WAIT = "threading.Event().wait(300)"


@pytest.mark.parametrize(
    ("act", "printed", "then"),
    [
        (IN_A_CALLBACK, [], WAIT),  # the exception is discarded where it is raised
        (IN_LLVM, ["stored"], WAIT),  # the code is used after it, so llvmlite's callbacks must come to their end
        (IN_A_RESULT, ["made"], WAIT),  # the type of a named tuple: numba uses it unchecked
        (IN_AN_IMPORT, ["imported"], WAIT),
        (IN_AN_IMPORT, ["imported"], f"stop_on_signals(print); {WAIT}"),
    ],
)
def test_an_interrupt_that_is_lost_where_it_arrives_comes_after_it(act, printed, then, tmp_path):
    (tmp_path / "sends.py").write_text("import __main__\n__main__.send()\nprint('imported')\n")
    program = BEFORE_A_RUN.format(act=act, then=then)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert (done.stdout.split(), done.stderr) == ([*printed, "returned", "interrupted"], "")


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


def catches_signals(process):
    """Return whether a process has a handler of SIGHUP, which Python by itself has not."""
    with open(f"/proc/{process.pid}/status") as status:
        caught = next(line for line in status if line.startswith("SigCgt:"))
    return int(caught.split()[1], 16) >> signal.SIGHUP - 1 & 1


@pytest.mark.long
@pytest.mark.system
@pytest.mark.parametrize(("signals", "latest_s", "is_cold"), [(100, 3.0, False), (15, 15.0, True)])
def test_signals_at_random_times_end_a_start_or_the_run(signals, latest_s, is_cold, tmp_path):
    """From the first line of evstim on, with kernels that are on disk, and with some that are compiled meanwhile."""
    (tmp_path / "small.toml").write_text(RIG)
    times = random.Random(7)
    for k in range(signals):
        environment = {**os.environ, **({"NUMBA_CACHE_DIR": str(tmp_path / f"cache{k}")} if is_cold else {})}
        process = subprocess.Popen(
            [*EVSTIM, "run", str(tmp_path / "small.toml")],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        while not catches_signals(process):
            assert process.poll() is None
        time.sleep(times.uniform(0.0, latest_s))  # any moment will do: none of them is waited for
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
        ended = (process.returncode, err.splitlines()[-1:]) == (1, ["evstim: interrupted"])
        assert ended or (process.returncode == 0 and "ledger: balanced" in out), (k, process.returncode, out, err)
        assert "Traceback" not in err
        assert "ignored" not in err
