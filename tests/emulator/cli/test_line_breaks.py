"""Lines of output: whole where they go to a file or a pipe, broken at the width of a terminal."""

import os
import pty
import subprocess
import sys

import pytest

from emulator.cli.app import _main

EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()"]
LONG = "nosuch" * 30


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_an_error_is_one_line(options, capsys):
    assert _main(["check", LONG, *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"evstim: '{LONG}'")
    assert line.endswith(".toml file")


def test_wrong_use_is_one_line_without_a_box(capsys):
    assert _main(["run", "loopback", f"--{LONG}"]) == 2
    assert capsys.readouterr().err.splitlines() == [f"evstim: Unknown option: --{LONG}."]


def test_each_option_of_the_help_is_one_line(capsys):
    assert _main(["run", "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    (record,) = (line for line in lines if line.strip().startswith("--record"))
    assert record.endswith("follows (not .npz).")
    assert not any(line != line.rstrip() for line in lines)


@pytest.mark.long
@pytest.mark.system
def test_the_log_has_whole_lines_without_padding(tmp_path):
    name = "a-link-whose-name-is-as-long-as-one-can-be-".ljust(64, "x")  # so its lines have more than 80 columns
    (tmp_path / "rig.toml").write_text(
        '[scene]\nkind = "checkerboard"\n[camera.sensor]\nwidth = 64\nheight = 48\n'
        f'[run]\nseconds = 0.02\npace = "free"\n[[links]]\nkind = "loopback"\nname = "{name}"\n'
    )
    command = [*EVSTIM, "run", tmp_path / "rig.toml"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    lines = done.stderr.splitlines()
    assert f"INFO     {name}: 0 events checked" in lines
    assert any(line.endswith("delivered") and name in line for line in lines)


def at_a_terminal(*arguments):
    """Run a command at a terminal of 60 columns; return its exit code and the octets that it prints."""
    own, theirs = pty.openpty()
    environment = {**os.environ, "COLUMNS": "60", "TERM": "xterm"}
    process = subprocess.Popen([*EVSTIM, *arguments], stdout=theirs, stderr=theirs, env=environment)
    os.close(theirs)
    told = b""
    try:
        while data := os.read(own, 4096):
            told += data
    except OSError:  # the other end is closed
        pass
    os.close(own)
    return process.wait(300), told


@pytest.mark.system
def test_a_terminal_gets_lines_of_its_width():
    code, told = at_a_terminal("check", LONG)
    assert code == 2
    assert len(told.splitlines()) > 3
    assert max(len(line) for line in told.decode().splitlines()) <= 60


@pytest.mark.system
def test_a_wrong_argument_does_not_reach_the_terminal_as_a_command():
    code, told = at_a_terminal("play", "a.raw", "--fps", "x\x1b]0;b\x07\x9b2J")
    assert (code, b"x\\x1b]0;b" in told) == (2, True)
    assert not any(command in told for command in (b"\x1b]", b"\x07", "\x9b".encode()))
