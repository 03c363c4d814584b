"""A package of one module as pip installs it, in a folder for PYTHONPATH: its module and its entry points."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

__all__ = ["environment", "evstim", "install"]

ROOT = Path(__file__).parents[1]


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


def evstim(site, *arguments):
    """Run a command with the packages of a folder."""
    return subprocess.run(
        [sys.executable, "-c", "from emulator.cli import main; main()", *map(str, arguments)],
        cwd=site, env=environment(site), capture_output=True, text=True, timeout=300,
    )  # fmt: skip
