"""The guest itself: it boots, runs programs, writes only where it may."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest

from tests.guest import image
from tests.guest.image import GuestUnavailable
from tests.guest.machine import Finished, Guest

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200)]


def test_runs_debians_kernel(guest: Guest) -> None:
    assert guest.check(["uname", "-r"]).strip() == guest.kernel.release


def test_reports_how_a_program_ended(guest: Guest) -> None:
    finished = guest.run(["sh", "-c", "echo out; echo err >&2; exit 3"])
    assert (finished.code, finished.stdout, finished.stderr) == (3, "out\n", "err\n")
    assert guest.run(["no-such-program"]).code == 127


PROGRAM = """
import os, sys, time
print(__name__, sys.argv[1:], "colorsys" in sys.modules, sys.path[0], end="")
print("err", file=sys.stderr, end="", flush=True)
{"code": lambda: sys.exit(3), "late": lambda: time.sleep(60), "abort": os.abort}[sys.argv[1]]()
"""


def run_program(guest: Guest, python: Path, end: str, timeout_s: float = 120.0) -> Finished:
    (guest.results / "program.py").write_text(PROGRAM)
    return guest.run([str(python), guest.path_in_guest("program.py"), end], timeout_s)


def test_a_program_that_is_forked_is_a_process_as_others(guest: Guest) -> None:
    python = Path(sys.executable)
    finished = run_program(guest, python, "code")
    assert (finished.code, finished.stderr) == (3, "err")
    assert finished.stdout == f"__main__ ['code'] False {guest.path_in_guest('')}"
    assert run_program(guest, python, "abort").code == -signal.SIGABRT
    late = run_program(guest, python, "late", timeout_s=2.0)
    assert (late.code, late.stderr) == (None, "err")


def test_an_interpreter_that_is_prepared_has_imported_modules(guest: Guest) -> None:
    python = Path(sys.executable).resolve()  # no other test prepares it
    guest.prepare(python, ("colorsys",))
    assert "['code'] True" in run_program(guest, python, "code").stdout


@pytest.mark.long
def test_ends_a_program_that_takes_too_long(guest: Guest) -> None:
    finished = guest.run(["sleep", "60"], timeout_s=0.5)
    assert finished.code is None
    assert "ran out of time" in str(finished)


def test_runs_programs_side_by_side(guest: Guest) -> None:
    waiting = guest.start(["sh", "-c", "until [ -e /tmp/go ]; do sleep 0.05; done; echo gone"], timeout_s=120)
    guest.check(["touch", "/tmp/go"])
    assert waiting.wait().stdout == "gone\n"


def test_writes_reach_the_host_only_in_the_results_folder(guest: Guest) -> None:
    guest.check(["sh", "-c", f"echo seen > {guest.path_in_guest('note')}; echo hidden > /evstim-guest-was-here"])
    assert (guest.results / "note").read_text() == "seen\n"
    assert not Path("/evstim-guest-was-here").exists()


def test_a_failed_program_is_quoted_with_the_console(guest: Guest) -> None:
    with pytest.raises(RuntimeError, match=r"(?s)cat /nowhere ended with 1.*No such file.*console of the guest"):
        guest.check(["cat", "/nowhere"])


@pytest.mark.long
def test_a_guest_left_alone_powers_itself_off(tmp_path: Path) -> None:
    """If the tests are killed, QEMU must not stay."""
    with Guest(tmp_path) as abandoned:
        abandoned._listener.close()
        assert abandoned._qemu.wait(240) == 0
        with pytest.raises(RuntimeError, match="the guest left with code 0"):
            abandoned.start(["true"], timeout_s=1)


def test_a_machine_without_debian_packages_is_told_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(GuestUnavailable, match="apt does not offer Debian's kernel"):
        image.fetch_kernel(tmp_path)
