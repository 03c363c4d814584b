#!/usr/bin/env python3
"""Check of the size of the code against `house.toml`: each number there may only fall. Exits with 1 on a difference.

    house.py            list the differences from house.toml
    house.py --table    print the numbers as they are
    house.py --toml     print them as house.toml

Counted are lines and modules of each folder, of the product (four packages) and of the laboratory, and in the product
these habits:

- bundled parameters: parameters typed as a tuple of several values, but a size, tuple[int, int]
- empty names: variables and parameters whose name is a word such as one, found, own, told, whole
- small private functions with one caller: at most four lines long
- packed assignments: three names or more in one statement
- empty docstrings: those that refer to another docstring only
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["House", "differences", "measured"]

PRODUCT, LABORATORY = ("evstim", "emulator", "transports", "firmware_protocol"), "laboratory"
HABITS = (
    "bundled parameters",
    "empty names",
    "small private functions with one caller",
    "packed assignments",
    "empty docstrings",
)
EMPTY_NAMES = frozenset(
    re.findall(
        r"\w+",
        """one some own mine there here those these found others known wanted told asked given drawn made both each less
        more most far near way much rest whole like what which why when who""",
    )
)
BUNDLE = re.compile(r"tuple\[(?!.*\.\.\.).+,")
EMPTY_DOCSTRING = re.compile(r"See `|That of|Those of|As given|Return it")
SMALL_LINES = 4

LEAST_SHARE = 0.97
SLACK_LINES, SLACK = 30, 3
RULE = "a rise is a commit of its own with its reason (CONTRIBUTING.md)"

Size = tuple[int, int]
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass
class House:
    """Numbers of a checkout.

    Attributes
    ----------
    total : (lines, modules) of "product" and "laboratory".
    folders : (lines, modules) of each folder of a package; a package's own name stands for its modules beside folders.
    habits : count of each habit.
    """

    total: dict[str, Size] = field(default_factory=dict)
    folders: dict[str, Size] = field(default_factory=dict)
    habits: dict[str, int] = field(default_factory=dict)


def measured(root: Path) -> House:
    """Return the numbers of the checkout at `root`."""
    house = House(total={"product": (0, 0), "laboratory": (0, 0)})
    habits, small, uses = Counter[str](), Counter[str](), Counter[str]()
    for package in (*PRODUCT, LABORATORY):
        part = "laboratory" if package == LABORATORY else "product"
        for path in sorted((root / package).rglob("*.py")):
            text, parents = path.read_text(), path.relative_to(root).parts[:-1]
            for sizes, key in ((house.total, part), (house.folders, "/".join(parents[:2]))):
                lines, modules = sizes.get(key, (0, 0))
                sizes[key] = (lines + text.count("\n"), modules + 1)
            for node in ast.walk(ast.parse(text)) if part == "product" else ():
                habits.update(_habits_of(node))
                match node:
                    case ast.Name(id=name, ctx=ast.Load()) | ast.Attribute(attr=name):
                        uses[name] += 1
                    case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) if _is_small_and_private(node):
                        small[name] += 1
    habits["small private functions with one caller"] = sum(small[name] == 1 == uses[name] for name in small)
    house.habits = {habit: habits[habit] for habit in HABITS}
    return house


def _habits_of(node: ast.AST) -> Iterator[str]:
    """Yield each habit that a node shows, once for each time."""
    match node:
        case ast.FunctionDef() | ast.AsyncFunctionDef():
            for parameter in (*node.args.args, *node.args.kwonlyargs):
                annotation = ast.unparse(parameter.annotation) if parameter.annotation else ""
                if BUNDLE.match(annotation) and annotation != "tuple[int, int]":
                    yield "bundled parameters"
        case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name) if name in EMPTY_NAMES:
            yield "empty names"
        case ast.Assign(targets=[ast.Tuple(elts=names), *_], value=ast.Tuple()) if len(names) >= 3:
            yield "packed assignments"
    if isinstance(node, Function | ast.ClassDef | ast.Module) and EMPTY_DOCSTRING.match(ast.get_docstring(node) or ""):
        yield "empty docstrings"


def _is_small_and_private(function: Function) -> bool:
    first, last = function.body[0].lineno, function.body[-1].end_lineno or 0
    return last - first < SMALL_LINES and function.name.startswith("_") and not function.name.startswith("__")


def differences(house: House, budget: House) -> list[str]:
    """Return a sentence for each number of a house that its budget does not allow."""
    sentences = []
    for number, unit in enumerate(("lines", "modules")):
        slack = SLACK_LINES if unit == "lines" else SLACK
        for sizes, allowed in ((house.total, budget.total), (house.folders, budget.folders)):
            for name in sorted({*sizes, *allowed}):
                size = sizes.get(name, (0, 0))[number], allowed.get(name, (0, 0))[number]
                sentences += _difference(name, unit, *size, slack)
    for habit in sorted({*house.habits, *budget.habits}):
        sentences += _difference("product", habit, house.habits.get(habit, 0), budget.habits.get(habit, 0), SLACK)
    return sentences


def _difference(name: str, unit: str, present: int, allowed: int, slack: int) -> list[str]:
    """Return the sentence for one number, or none."""
    if present > allowed:
        return [f"{name} has {present} {unit}, house.toml allows {allowed}: remove {present - allowed}; {RULE}"]
    if present < min(allowed * LEAST_SHARE, allowed - slack) or present == 0 < allowed:
        return [f"{name} has {present} {unit}, house.toml allows {allowed}: lower it to {present}"]
    return []


def budget_of(root: Path) -> House:
    """Return the numbers in house.toml."""
    tables = tomllib.loads((root / "house.toml").read_text())
    sizes = {part: {name: (size[0], size[1]) for name, size in tables[part].items()} for part in ("total", "folders")}
    return House(sizes["total"], sizes["folders"], tables["habits"])


def toml_of(house: House) -> str:
    """Return the numbers as the text of house.toml."""
    lines = ["# Lines and modules of each folder, and counts of habits; `.ci/house.py` compares. They may only fall."]
    lines += [f"# {RULE[0].upper()}{RULE[1:]}; `.ci/house.py --toml` prints this file anew.", "", "[total]"]
    lines += [f"{part} = [{size[0]}, {size[1]}]" for part, size in house.total.items()]
    lines += ["", "[folders]", *(f'"{name}" = [{size[0]}, {size[1]}]' for name, size in sorted(house.folders.items()))]
    lines += ["", "[habits]", *(f'"{habit}" = {count}' for habit, count in house.habits.items())]
    return "\n".join(lines) + "\n"


def table_of(house: House) -> str:
    """Return the numbers as a table for people, the largest folder first."""
    folders = sorted(house.folders.items(), key=lambda item: -item[1][0])
    rows = [f"{lines:7} lines {modules:4} modules  {name}" for name, (lines, modules) in folders]
    totals = [f"{lines:7} lines {modules:4} modules  {part}" for part, (lines, modules) in house.total.items()]
    return "\n".join([*rows, "", *totals, "", *(f"{count:7}  {habit}" for habit, count in house.habits.items())])


def main(arguments: list[str]) -> int:
    """Print what the arguments request; return the exit code."""
    root = Path(__file__).parents[1]
    house = measured(root)
    if "--toml" in arguments:
        text = (root / "house.toml").read_text()
        print(toml_of(house) + "\n" + text[text.index("[seconds]") :], end="")
        return 0
    if "--table" in arguments:
        print(table_of(house))
        return 0
    sentences = differences(house, budget_of(root))
    print("\n".join([*sentences, f"{len(sentences)} differences from house.toml"]))
    return 1 if sentences else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
