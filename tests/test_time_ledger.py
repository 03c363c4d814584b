"""The ledger of the time of tests: what it counts, and its budget."""

import importlib.util
import json
from pathlib import Path

import pytest

from tests import time_ledger

ROOT = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("times", ROOT / ".ci" / "times.py")
times = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(times)

pytest_plugins = ["pytester"]

BUSY = """
import subprocess, sys, time
LOOP = "import time\\nwhile time.process_time() < {s}: pass"

def test_itself():
    end = time.process_time() + 0.3
    while time.process_time() < end:
        pass

def test_in_a_child():
    subprocess.run([sys.executable, "-c", LOOP.format(s=0.4)], check=True)
"""


@pytest.mark.system
def test_processor_time_is_counted_by_file_with_children(pytester, monkeypatch):
    monkeypatch.setenv("TEST_PART", "sample")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    pytester.makeconftest(
        "from pathlib import Path\nfrom tests import time_ledger\nfrom tests.time_ledger import pytest_configure\n"
        "time_ledger.FOLDER = Path(__file__).parent / 'times'\n"
    )
    pytester.makepyfile(test_busy=BUSY)
    assert pytester.runpytest_subprocess("-n", "1").ret == 0
    files = json.loads((pytester.path / "times" / "sample.json").read_text())
    assert set(files) == {"test_busy.py", time_ledger.REST}
    assert files["test_busy.py"]["processor"] >= 0.7
    assert files[time_ledger.REST]["processor"] > 0


@pytest.mark.parametrize(("processor_s", "scale", "sentences"), [(140, 1, 0), (160, 1, 1), (160, 2, 0), (320, 2, 1)])
def test_a_part_fails_beyond_one_and_a_half_times_its_budget(processor_s, scale, sentences):
    file = {"processor": processor_s / 2, "wall": 9e9, "compiled": 0.0}
    ledger = {"fast": {"a.py": file, "b.py": file}, "without a budget": {"c.py": {"processor": 1e6}}}
    assert len(times.broken(ledger, {"fast": 100.0}, scale)) == sentences
