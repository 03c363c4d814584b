"""Every shipped rig loads and draws with the base dependencies alone."""

import json
import subprocess
import sys

import pytest

from emulator.rig.loading import shipped_rigs

pytestmark = pytest.mark.system

# The optional packages look as if they were not installed.
BLOCKED = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"PIL", "matplotlib", "faery", "av"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Missing())
from emulator.cli import main
main()
"""


@pytest.mark.gl
@pytest.mark.parametrize("rig", shipped_rigs())
def test_a_shipped_rig_needs_no_optional_package(rig, gl):
    command = [sys.executable, "-c", BLOCKED, "check", rig, "--draw", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["good"] is True
