"""The check of words in code finds the beginnings of all docstrings, those of attributes too."""

import importlib.util
from pathlib import Path

SCRIPT = Path(__file__).parents[1] / ".ci" / "words.py"


def lines_of(tmp_path, source):
    spec = importlib.util.spec_from_file_location("words", SCRIPT)
    words = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(words)
    path = tmp_path / "module.py"
    path.write_text(source)
    return [line for line, _ in words.offences(path)]


def test_docstrings_of_modules_classes_functions_and_attributes(tmp_path):
    source = '''"""When it is."""

LIMIT = 3
"""What is allowed."""


class Box:
    """Who holds it."""

    depth_m: float = 1.0
    """Where it ends."""

    def open(self):
        """Whether it opens."""
        depth = 2
        """What a local is."""
        return depth
'''
    assert sorted(lines_of(tmp_path, source)) == [1, 4, 8, 11, 14, 16]
