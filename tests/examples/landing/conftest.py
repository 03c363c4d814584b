"""Parts of examples/landing, tested in a process of their own (test_examples.py): its modules have short names."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3] / "examples" / "landing"))
