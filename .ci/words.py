#!/usr/bin/env python3
"""Check of the words in code: `words.py [FOLDER ...]` lists each offence and exits with 1 if there is any.

Three rules, from CONTRIBUTING.md:

- A docstring begins with a noun phrase or an imperative, not with what, where, who, when or whether.
- Programs send, receive, read, report and raise; they do not tell, say, hear, ask, speak or know.
- Words that only this project used are gone, in names as well.

Docstrings, comments and text in quotes are searched for the second rule, all code for the third; keys of data in files
and on lines ("told") are not words. `--count` prints numbers by folder instead of the list.
"""

from __future__ import annotations

import ast
import inspect
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

__all__ = ["offences"]

FOLDERS = ("evstim", "emulator", "transports", "firmware_protocol", "laboratory")

OPENINGS = re.compile(r"(What|Where|Who|Whom|Whose|When|Whether|Nobody|Whoever|Whatever|Why|How)\b")
SPEECH = re.compile(
    r"\b(tell|tells|told|telling|say|says|said|saying|hear|hears|heard|hearing|ask|asks|asked|asking|speak|speaks|spoke"
    r"|knows|whoever|somebody|nobody)\b",
    re.IGNORECASE,
)
KEY = re.compile(r"[\"'][a-z_]+[\"']")
COINED = re.compile(
    r"\b_?(Thrower|Crew|Glow|Meeting|IsoTpMail|CfpMail)\w*\b|\b(halving|blamed|struck)\b|_(told|heard|asked|said)\b|\b(told|heard|asked|said)_"
)


def _docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and text of each docstring: also a string right after an assignment documents its target."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(tree):
        if isinstance(node, kinds):
            documented = [
                after for before, after in pairwise(node.body) if isinstance(before, ast.Assign | ast.AnnAssign)
            ]
            yield from ((one.lineno, text) for one in (*node.body[:1], *documented) if (text := _string(one)))


def _string(statement: ast.stmt) -> str:
    """Return the text of a string that stands alone, "" of any other statement."""
    match statement:
        case ast.Expr(ast.Constant(str() as text)):
            return inspect.cleandoc(text)
    return ""


def offences(path: Path) -> Iterator[tuple[int, str]]:
    """Return the line and the reason of each offence in a Python file."""
    text = path.read_text()
    for line, docstring in _docstrings(ast.parse(text)):
        if found := OPENINGS.match(docstring):
            yield line, f"a docstring begins with {found[0]!r}"
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if KEY.fullmatch(token.string):
            continue
        if token.type in (tokenize.COMMENT, tokenize.STRING):
            for found in SPEECH.finditer(token.string):
                yield token.start[0] + token.string[: found.start()].count("\n"), f"speech: {found[0]!r}"
        if token.type in (tokenize.COMMENT, tokenize.STRING, tokenize.NAME):
            for found in COINED.finditer(token.string):
                yield token.start[0] + token.string[: found.start()].count("\n"), f"not a standard word: {found[0]!r}"


def main(arguments: list[str]) -> int:
    """Print the offences below the folders; return the exit code."""
    counting = "--count" in arguments
    folders = [Path(one) for one in arguments if not one.startswith("--")] or [Path(one) for one in FOLDERS]
    counts: Counter[str] = Counter()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            for line, reason in offences(path):
                counts[str(path.parent)] += 1
                if not counting:
                    print(f"{path}:{line}: {reason}")
    if counting:
        print("\n".join(f"{number:6} {folder}" for folder, number in sorted(counts.items())))
    print(f"{sum(counts.values())} offences")
    return 1 if counts else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
