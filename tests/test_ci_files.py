"""The workflow for other repositories and the Containerfile: what they name exists, and the workflow's script runs.

Neither a forge nor a container engine is asked; the script of the workflow is run by bash as the forge would.
"""

import os
import re
import shlex
import subprocess
import sys
from itertools import product
from pathlib import Path

import pytest
import yaml

from emulator.cli.app import app

ROOT = Path(__file__).parents[1]
WORKFLOW = yaml.safe_load((ROOT / ".github/workflows/bench.yml").read_text())
(JOB,) = WORKFLOW["jobs"].values()
STEPS = JOB["steps"]
CONTAINERFILE = (ROOT / "Containerfile").read_text()
MARKERS = ("guest", "arm", "anew", "system", "long")
(SCRIPT,) = (step for step in STEPS if step.get("name") == "run")


def run_lines():
    """Return the RUN instructions of the Containerfile, each on one line."""
    joined = CONTAINERFILE.replace("\\\n", " ")
    return [line.removeprefix("RUN ") for line in joined.splitlines() if line.startswith("RUN ")]


def evstim_commands():
    """Return all calls of evstim as words: of the workflow, of the Containerfile and of its comment."""
    texts = [step["run"] for step in STEPS if "run" in step] + run_lines()
    texts += [line.partition(" evstim evstim ")[2] for line in CONTAINERFILE.splitlines() if " evstim evstim " in line]
    found = [call for text in texts for call in re.findall(r"(?:^|&& |\s)evstim ([^&|;\n]*)", text, re.MULTILINE)]
    return [shlex.split(call) for call in found]


def options_of(verb):
    """Return the options of a verb by the command line's own account."""
    assembled = app[verb].assemble_argument_collection()
    return {name for argument in assembled for name in argument.names}


def test_nothing_from_outside_is_put_into_a_script_but_by_its_environment():
    for step in STEPS:
        assert "${{" not in step.get("run", "")
        assert all(f'"${name}"' in step["run"] for name in step.get("env", {}))


def test_each_command_is_a_verb_of_evstim_with_options_that_it_has():
    commands = evstim_commands()
    assert {words[0] for words in commands} == {"doctor", "run"}
    for verb, *words in commands:
        assert {word for word in words if word.startswith("--")} <= options_of(verb), (verb, words)


@pytest.fixture
def script_run(tmp_path):
    """Run the workflow's script as the forge does, `bash -e`, with evstim of this tree on the path."""
    (tmp_path / "bin").mkdir()
    command = tmp_path / "bin" / "evstim"
    command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m evstim "$@"\n')
    command.chmod(0o755)
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    found = f"{command.parent}{os.pathsep}{os.environ['PATH']}"

    def run(**inputs):
        environment = os.environ | {"PATH": found, "PYTHONPATH": path} | inputs
        (tmp_path / "script.sh").write_text(SCRIPT["run"])
        return subprocess.run(["bash", "-e", "script.sh"], cwd=tmp_path, env=environment, timeout=300).returncode

    assert set(SCRIPT["env"]) == {"RIG", "SECONDS_OF_RUN", "PROGRAM"}
    return run


@pytest.fixture
def unpaced(tmp_path):
    """Write loopback without a pace as mine.toml: on a busy machine a paced run is late, and its verdict bad."""
    rig = (ROOT / "rigs" / "loopback.toml").read_text()
    (tmp_path / "mine.toml").write_text(rig.replace("[run]\n", '[run]\npace = "free"\n'))


@pytest.mark.system
@pytest.mark.usefixtures("unpaced")
def test_the_script_runs_the_rig_and_a_program_beside_it(script_run, tmp_path):
    assert script_run(RIG="mine.toml", SECONDS_OF_RUN="0.2", PROGRAM="grep -q loopback ready.json && touch seen") == 0
    assert (tmp_path / "seen").is_file()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"report.html", "report.json", "junit.xml"}


@pytest.mark.long
@pytest.mark.system
@pytest.mark.usefixtures("unpaced")
def test_a_program_that_fails_ends_the_run_fails_the_job_and_leaves_the_report(script_run, tmp_path):
    assert script_run(RIG="mine.toml", SECONDS_OF_RUN="0", PROGRAM="exit 7") == 7
    assert (tmp_path / "out" / "junit.xml").is_file()


@pytest.mark.system
def test_a_rig_that_is_not_there_fails_the_job_and_starts_no_program(script_run, tmp_path):
    assert script_run(RIG="no-such-rig", SECONDS_OF_RUN="1", PROGRAM="touch seen") == 2
    assert not (tmp_path / "seen").exists()


def test_each_test_is_in_one_part_of_the_makefile():
    makefile = (ROOT / "Makefile").read_text()
    calls = re.findall(r'pytest (tests/laboratory )?-m "([^"]*)"( --ignore tests/laboratory)?', makefile)
    assert len(calls) == makefile.count("/pytest ") == 6
    for in_laboratory, *marks in product((False, True), repeat=1 + len(MARKERS)):
        is_marked = dict(zip(MARKERS, marks, strict=True))
        own = [call for call in calls if not (call[2] if in_laboratory else call[0])]
        parts = [expression for _, expression, _ in own if eval(expression, is_marked)]
        assert len(parts) == 1, (in_laboratory, is_marked, parts)


def test_the_forge_runs_the_parts_of_make_test():
    (job,) = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text())["jobs"].values()
    parts = set(job["strategy"]["matrix"]["part"])
    recipe = re.search(r"^test:\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)[1]
    made = " ".join(re.findall(r"\$\(MAKE\)(?: -j\d)? (.*)", recipe)).split()
    assert parts == set(made) - {"packages", "prepare"}
    assert [step["run"] for step in job["steps"] if "run" in step] == ["make packages", 'make "$PART"']
