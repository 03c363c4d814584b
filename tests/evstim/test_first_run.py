"""The first run on a machine, which compiles the kernels, has the events of the next one."""

import hashlib
import os
import subprocess
import sys

import pytest

RUN = """
import hashlib
import evstim

rig = evstim.Rig("board", "board", evstim.CheckerboardScene(), links=())
digest = hashlib.sha256()
with evstim.run(rig, seconds=0.5, pace="free") as run:
    for events in run:
        digest.update(events.tobytes())
print(digest.hexdigest())
"""


def digest_with(cache):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, "-c", RUN], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip(), "compiling" in done.stderr


@pytest.mark.anew
def test_it_has_the_same_events(tmp_path):
    first, compiled = digest_with(tmp_path)
    again, compiled_again = digest_with(tmp_path)
    assert compiled
    assert not compiled_again
    assert first == again != hashlib.sha256().hexdigest()
