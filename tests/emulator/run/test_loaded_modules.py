"""A run loads the modules of its own rig, and not those of other scenes, cameras and links."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
OURS = re.compile(r"^(?:evstim|emulator|transports|firmware_protocol)\b.*", re.MULTILINE)
MOST_IN_SESSION, MOST_IN_LINK = 150, 125

RECORDER = """
import atexit, multiprocessing.util, os, sys

def record():
    with open(os.path.join(os.environ["LOADED"], f"{os.getpid()}.txt"), "w") as file:
        file.write("\\n".join(sys.modules))

atexit.register(record)
multiprocessing.util.Finalize(None, record, exitpriority=0)  # a process of multiprocessing leaves out atexit
"""


@pytest.mark.system
def test_a_run_of_loopback_loads_few_modules(tmp_path):
    """Imported by each Python process, `sitecustomize` writes the names of its modules when it ends."""
    (tmp_path / "sitecustomize.py").write_text(RECORDER)
    (tmp_path / "loaded").mkdir()
    command = "from emulator.cli import main; main()"
    subprocess.run(
        [sys.executable, "-c", command, "run", "loopback", "--seconds", "0.05", "--pace", "free"],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}", "LOADED": str(tmp_path / "loaded")},
        check=True,
        timeout=600,
    )
    processes = [OURS.findall(path.read_text()) for path in (tmp_path / "loaded").iterdir()]
    (session,) = (modules for modules in processes if "emulator.cli.run" in modules)
    (link,) = (modules for modules in processes if "transports.usb.cameras" in modules)
    assert len(session) <= MOST_IN_SESSION, sorted(session)
    assert len(link) <= MOST_IN_LINK, sorted(link)
