"""Temporary folders: gone at their end, and after a kill at the next; nothing else is ever removed."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from transports.output_file import TemporaryFolder, lasting_folder

MAKE = """
import sys
from pathlib import Path
from transports.output_file import TemporaryFolder, lasting_folder
folder, lasting = TemporaryFolder("a"), lasting_folder("b")
for path in (Path(folder.name), lasting):
    (path / "below").mkdir()
    (path / "below" / "file").write_text("x")
    print(path, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def tmpdir_of_all(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    return tmp_path


@pytest.fixture
def process(tmpdir_of_all):
    """Start a process that makes a folder of each kind and waits; return it and the folders."""
    started = []

    def start(code=MAKE):
        run = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        started.append(run)
        return run, [Path(run.stdout.readline().strip()) for _ in range(2)]

    yield start
    for run in started:
        run.kill()
        run.communicate()


def killed(run):
    run.send_signal(signal.SIGKILL)
    run.wait()


def test_a_killed_process_s_folders_are_removed_by_the_next(process):
    run, folders = process()
    killed(run)
    assert all((folder / "below" / "file").exists() for folder in folders)
    with TemporaryFolder("next") as mine:
        assert not any(folder.exists() for folder in folders)
        assert Path(mine).is_dir()
    assert not Path(mine).exists()


def test_the_folders_of_a_process_that_lives_stay(process):
    run, folders = process()
    for _ in range(2):
        lasting_folder("next")
    assert all((folder / "below" / "file").exists() for folder in folders)
    run.communicate("")  # it ends
    assert not folders[0].exists()
    assert [path.name for path in folders[1].iterdir()] == ["below"]
    lasting_folder("next")
    assert folders[1].is_dir()


def test_a_lasting_folder_without_content_is_removed_at_the_end(process):
    run, _ = process(MAKE.replace('    (path / "below").mkdir()\n    (path / "below" / "file").write_text("x")\n', ""))
    run.communicate("")
    assert list(Path(os.environ["TMPDIR"]).iterdir()) == []


def test_nothing_of_others_is_removed(process, tmpdir_of_all, tmp_path_factory):
    run, (leftover, lasting) = process()
    killed(run)
    elsewhere = tmp_path_factory.mktemp("mine") / "data"
    shutil.copytree(lasting, elsewhere)
    others = [tmpdir_of_all / name for name in ("evstim-mine", "evstim-a-copied12", "tmpabcd1234", "evstim-a-renamed1")]
    others[0].mkdir()
    shutil.copytree(leftover, others[1])
    shutil.copytree(leftover, others[2])
    lasting.rename(others[3])
    (tmpdir_of_all / "evstim-a-link0000").symlink_to(elsewhere)
    (tmpdir_of_all / "evstim-a-file0000").write_text("mine")
    pipe = tmpdir_of_all / "evstim-a-pipe0000"
    pipe.mkdir()
    os.mkfifo(pipe / ".evstim-temporary")
    with TemporaryFolder("next"):
        assert not leftover.exists()
        assert all(path.is_dir() for path in [*others, elsewhere, pipe])
        assert (elsewhere / "below" / "file").exists()
        assert (tmpdir_of_all / "evstim-a-file0000").exists()


def test_a_folder_of_its_own_parent_is_cleaned_there(tmp_path):
    with TemporaryFolder("array", tmp_path) as folder:
        assert Path(folder).parent == tmp_path
    assert list(tmp_path.iterdir()) == []


DEMO = """
import os, sys
import emulator.cli.demo as demo
from emulator.cli.output import Failure
def run(*_):
    print("x", *os.listdir(os.environ["TMPDIR"]), flush=True)
    END
demo._run = run
try:
    demo.demo("eros")
except Failure:
    pass
"""


def test_a_killed_demo_leaves_nothing_behind_the_next(tmp_path):
    listed = []
    for end in ("os.kill(os.getpid(), 9)", "raise Failure('it ends', 1)"):
        code, env = DEMO.replace("END", end), {**os.environ, "TMPDIR": str(tmp_path)}
        done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
        assert done.returncode in (-9, 0), done.stderr
        listed.append({*done.stdout.split()[1:]})
    assert len(listed[0]) == len(listed[1]) == 2
    assert not listed[0] & listed[1]
    assert list(tmp_path.iterdir()) == []
