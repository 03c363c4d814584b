"""The time for compiling: no kernel is compiled for two sets of types."""

import json
import os
import subprocess
import sys

import pytest

COUNTS = """
import collections, json
from numba.core import event
counts = collections.Counter()
class Listener(event.Listener):
    def on_start(self, e):
        function = e.data["dispatcher"].py_func
        counts[f"{function.__module__}.{function.__qualname__}"] += 1
    def on_end(self, e):
        pass
event.register("numba:compile", Listener())
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
Sensor(PRESETS["davis346"], 0).warm_up()
print(json.dumps(counts))
"""


@pytest.mark.anew
def test_each_kernel_of_the_sensor_is_compiled_once(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", COUNTS], env=environment, capture_output=True, text=True, timeout=600, check=True
    )
    ours = {name: n for name, n in json.loads(done.stdout).items() if name.startswith("emulator.")}
    assert len(ours) > 50
    assert {name: n for name, n in ours.items() if n > 1} == {}
