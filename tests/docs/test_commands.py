"""Commands of evstim on all pages: each is one of the command line's, with its arguments and options."""

import shlex
from itertools import groupby
from pathlib import Path

import pytest

from emulator.cli.app import app
from tests.typed_commands import commands_of, without_comment

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "examples").glob("*/README.md"))]


def evstim_commands(page):
    """Return the words of each command of evstim, without what a shell does with it."""
    lines = "\n".join(without_comment(line)[0] for line in commands_of(page.read_text(encoding="utf-8")))
    for line in lines.replace("\\\n", " ").splitlines():
        words = shlex.shlex(line, posix=True, punctuation_chars=True)
        words.whitespace_split = True
        parts = [list(part) for is_end, part in groupby(words, lambda word: set(word) <= set("&|;<>()")) if not is_end]
        yield from (part[1:] for part in parts if part[0] == "evstim")


@pytest.mark.system
def test_each_command_can_be_parsed():
    commands = [(page.name, words) for page in PAGES for words in evstim_commands(page)]
    assert len(commands) > 60
    wrong = []
    for page, words in commands:
        try:
            app.parse_args(words, print_error=False, exit_on_error=False)
        except Exception as error:  # noqa: BLE001 - any error of the command line's library
            wrong.append(f"{page}: evstim {' '.join(words)}: {error}")
    assert wrong == []
