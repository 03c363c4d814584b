"""The examples of docs/python.md, docs/reports.md and docs/datasets.md run as they are printed."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/python.md").read_text()
FENCE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
BLOCKS = FENCE.findall(PAGE)
TESTING = [block for block in FENCE.findall((ROOT / "docs/reports.md").read_text()) if "@pytest" not in block]
DATASETS = FENCE.findall((ROOT / "docs/datasets.md").read_text())
TITLES = [PAGE[: PAGE.index(block)].rpartition("\n## ")[2].partition("\n")[0] for block in BLOCKS]

IDS = [*TITLES, *(f"testing {k}" for k in range(len(TESTING))), *(f"data set {k}" for k in range(len(DATASETS)))]


def test_the_page_has_its_examples():
    assert len(BLOCKS) >= 8
    assert all(block.count("\n") <= 15 for block in BLOCKS)


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("block", [*BLOCKS, *TESTING, *DATASETS], ids=IDS)
def test_an_example_runs(block, tmp_path):
    script = tmp_path / "example.py"
    script.write_text(block)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"}
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
