"""A package of one module as pip installs it, in a folder for PYTHONPATH: its module and its entry points."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

__all__ = ["environment", "evstim_in_turn", "install"]

ROOT = Path(__file__).parents[1]

IN_TURN = """
import contextlib, io, json, sys
from emulator.cli.app import _main

if __name__ == "__main__":
    ends = []
    for command in json.loads(sys.argv[1]):
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
            code = _main(command)
        ends.append({"code": code, "out": out.getvalue(), "err": err.getvalue()})
    print(json.dumps(ends))
"""


def install(project, site, **changes):
    """Install the package whose pyproject.toml lies in a folder; `changes` are other targets by entry point."""
    table = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    site.mkdir(exist_ok=True)
    for module in project.glob("*.py"):
        shutil.copy(module, site)
    info = site / f"{table['name'].replace('-', '_')}-{table['version']}.dist-info"
    info.mkdir(exist_ok=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {table['name']}\nVersion: {table['version']}\n")
    lines = []
    for group, points in table["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {changes.get(name, target)}" for name, target in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return site


def environment(site):
    """Return the variables of a process that has the packages of a folder."""
    return {**os.environ, "PYTHONPATH": f"{site}{os.pathsep}{ROOT}"}


def evstim_in_turn(site, *commands):
    """Run commands with the packages of a folder, one after another in one process; return `code`, `out`, `err`."""
    (site / "in_turn.py").write_text(IN_TURN)
    words = json.dumps([[str(word) for word in command] for command in commands])
    done = subprocess.run(
        [sys.executable, "in_turn.py", words],
        cwd=site, env=environment(site), capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [SimpleNamespace(**end) for end in json.loads(done.stdout.splitlines()[-1])]
