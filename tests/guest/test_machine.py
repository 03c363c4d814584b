"""The guest itself: it boots, runs programs, writes only where it may."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.guest import image
from tests.guest.image import GuestUnavailable
from tests.guest.machine import Guest

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(1200)]


def test_runs_debians_kernel(guest: Guest) -> None:
    assert guest.check(["uname", "-r"]).strip() == guest.kernel.release


def test_reports_how_a_program_ended(guest: Guest) -> None:
    finished = guest.run(["sh", "-c", "echo out; echo err >&2; exit 3"])
    assert (finished.code, finished.stdout, finished.stderr) == (3, "out\n", "err\n")
    assert guest.run(["no-such-program"]).code == 127


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
