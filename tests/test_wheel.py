"""The wheel stands alone: rigs and shapes are in it, and it runs outside the checkout."""

import json
import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from emulator.rig.loading import load_rig, shipped_rigs
from emulator.run.machine import needs_of

ROOT = Path(__file__).parent.parent


def pip(*arguments):
    command = [sys.executable, "-m", "pip", *map(str, arguments), "--quiet", "--disable-pip-version-check"]
    subprocess.run(command, check=True, timeout=300, stderr=subprocess.PIPE)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    pip("wheel", ROOT, "--no-deps", "--wheel-dir", folder)
    (path,) = folder.glob("evstim-*.whl")
    return path


@pytest.mark.system
def test_what_is_in_the_wheel(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for path in (ROOT / "emulator/scene/bodies/shapes").iterdir():
        assert str(path.relative_to(ROOT)) in names
    assert {f"evstim/rigs/{path.name}" for path in (ROOT / "rigs").glob("*.toml")} < names
    assert "evstim/py.typed" in names
    rooms = {name.partition("/")[0] for name in names if ".dist-info" not in name}
    assert rooms == {"evstim", "emulator", "transports", "firmware_protocol"}


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The `evstim` of a fresh environment with the wheel and its base dependencies, and nothing else."""
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder, with_pip=True)
    command = [folder / "bin" / "pip", "install", "--quiet", "--disable-pip-version-check", wheel]
    subprocess.run(command, check=True, timeout=600)
    return folder / "bin" / "evstim"


@pytest.mark.anew
@pytest.mark.parametrize("rig", shipped_rigs())
def test_a_shipped_rig_runs_from_an_installed_wheel(installed, rig, tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [installed, "run", rig, "--seconds", "0.02", "--pace", "free", "--json"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    if missing := [need.look().name for need in needs_of(load_rig(rig)) if need.by == "run"]:
        error = json.loads(done.stdout.splitlines()[-1])["error"]
        assert (done.returncode, missing[0] in error, "pip install '.[" in error) == (3, True, True), done.stderr
        return
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["balanced"] is True


@pytest.mark.anew
def test_a_fresh_environment_has_no_optional_package(installed):
    code = "import importlib.util as u; print([n for n in ('PIL', 'matplotlib', 'faery', 'av') if u.find_spec(n)])"
    done = subprocess.run([installed.parent / "python", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
