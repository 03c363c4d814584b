"""The wheel stands alone: rigs and shapes are in it, and it runs outside the checkout."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

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


def test_what_is_in_the_wheel(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for path in (ROOT / "emulator/scene/bodies/shapes").iterdir():
        assert str(path.relative_to(ROOT)) in names
    assert {f"evstim/rigs/{path.name}" for path in (ROOT / "rigs").glob("*.toml")} < names
    assert "evstim/py.typed" in names
    rooms = {name.partition("/")[0] for name in names if ".dist-info" not in name}
    assert rooms == {"evstim", "emulator", "transports", "firmware_protocol"}


@pytest.mark.anew
def test_an_installed_wheel_runs_elsewhere(wheel, tmp_path):
    site = tmp_path / "site"
    pip("install", wheel, "--no-deps", "--target", site)
    code = "import evstim, sys; from evstim.__main__ import main; print(evstim.__file__, file=sys.stderr); main()"
    environment = {**os.environ, "PYTHONPATH": str(site)}
    done = subprocess.run(
        [sys.executable, "-c", code, "run", "loopback", "--seconds", "0.05", "--pace", "free", "--json"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert str(site) in done.stderr
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["balanced"] is True
