"""Standard output that takes nothing: exit code of the rules, no traceback, no message where it has no reader."""

import io
import os
import subprocess
import sys

import pytest

from emulator.cli.output import Failure, ResultFile

EVSTIM = [sys.executable, "-c", "from emulator.cli import main; main()"]
REASONS = {"full": "No space left on device", "broken": "", "closed": "stdout is closed"}
CODES = {"full": 3, "broken": 128 + 13, "closed": 3}  # the second: as shells show an end by SIGPIPE
RIG = """
[scene]
kind = "checkerboard"
[camera.sensor]
width = 64
height = 48
[run]
seconds = 0.05
pace = "free"
[[links]]
kind = "loopback"
"""


@pytest.fixture
def broken_pipe():
    """The writing end of a pipe that has no reader."""
    reading, writing = os.pipe()
    os.close(reading)
    yield writing
    os.close(writing)


def test_a_broken_pipe_fails_once_and_then_discards(broken_pipe):
    file = ResultFile(broken_pipe)
    with pytest.raises(Failure, match="stdout: Broken pipe") as failure:
        file.write(b"result")
    assert failure.value.exit_code == CODES["broken"]
    assert file.write(b"more") == 4


def test_text_in_the_buffers_is_discarded_after_the_failure(broken_pipe):
    text = io.TextIOWrapper(io.BufferedWriter(ResultFile(broken_pipe)))
    text.write("result")
    with pytest.raises(Failure):
        text.flush()
    text.close()


def test_what_can_be_written_arrives():
    reading, writing = os.pipe()
    with open(reading, "rb") as arrived, open(writing, "wb") as pipe:
        text = io.TextIOWrapper(io.BufferedWriter(ResultFile(pipe.fileno())), encoding="utf-8")
        text.write("µs\n")
        text.close()
        pipe.close()
        assert arrived.read() == "µs\n".encode()


@pytest.fixture
def run(broken_pipe):
    """Run evstim with a stdout that takes nothing; return the exit code and stderr."""

    def run_to(stdout, *arguments):
        command = [*EVSTIM, *map(str, arguments)]
        if stdout == "closed":
            command = ["sh", "-c", 'exec "$@" >&-', "sh", *command]
        with open("/dev/full", "wb") as full:
            to = {"full": full, "broken": broken_pipe, "closed": None}[stdout]
            done = subprocess.run(command, stdout=to, stderr=subprocess.PIPE, text=True, timeout=300, check=False)
        assert "Traceback" not in done.stderr
        assert "Exception ignored" not in done.stderr
        return done.returncode, done.stderr

    return run_to


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("stdout", REASONS)
def test_the_json_of_a_run_that_cannot_be_written(stdout, run, tmp_path):
    (tmp_path / "small.toml").write_text(RIG)
    code, told = run(stdout, "run", tmp_path / "small.toml", "--json", "--record", tmp_path / "a.npz")
    assert code == CODES[stdout]
    assert REASONS[stdout] in told
    assert told.count("stdout") == (stdout != "broken")
    assert (tmp_path / "a.npz").stat().st_size > 0


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("arguments", [["rigs", "--json"], ["rigs"], ["--version", "--json"], ["run", "--help"]])
@pytest.mark.parametrize("stdout", ["full", "broken"])
def test_every_result_that_cannot_be_written(stdout, arguments, run):
    code, told = run(stdout, *arguments)
    assert code == CODES[stdout]
    assert told.count(REASONS["full"]) == (stdout == "full")
    assert bool(told) == (stdout == "full")


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("stdout", REASONS)
def test_an_error_keeps_its_message_and_its_exit_code(stdout, run):
    code, told = run(stdout, "check", "nosuch", "--json")
    assert code == 2
    assert "'nosuch' is not known" in told
    assert told.count("stdout") == (stdout == "full")


@pytest.mark.system
def test_text_for_people_may_be_closed(run):
    assert run("closed", "rigs") == (0, "")
