"""Success of a run, by the rig's verdict, the program's exit and rules such as "result.error < 0.05".

The share of successes has a confidence interval.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from scipy.stats import binomtest

_COMPARE: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_WORDS = {"verdict": ("verdict", "==", True), "program": ("program.exit", "==", 0)}


@dataclass(frozen=True)
class SuccessRule:
    """A column of a row, compared with a value.

    Attributes
    ----------
    text : the rule as in the campaign file.
    """

    text: str
    column: str
    op: str
    value: float | str | bool

    def kept_by(self, row: Mapping[str, Any]) -> bool:
        """Return whether a row keeps the rule; a row without a value there does not."""
        found = row.get(self.column)
        if found is None or isinstance(found, str) != isinstance(self.value, str):
            return False
        return _COMPARE[self.op](found, self.value)


def parse_rule(text: object) -> SuccessRule:
    """Return a rule from its text in a campaign file; raises ValueError."""
    if not isinstance(text, str):
        raise ValueError(f'expected text such as "result.error < 0.05", got {text!r}')
    if text in _WORDS:
        return SuccessRule(text, *_WORDS[text])
    parts = text.split(maxsplit=2)
    if len(parts) != 3 or parts[1] not in _COMPARE:
        raise ValueError(
            f'expected "verdict", "program" or "COLUMN OP VALUE" with one of {" ".join(_COMPARE)}, got {text!r}'
        )
    column, op, value = parts
    rule = SuccessRule(text, column, op, _value(value))
    if op in ("<", "<=", ">", ">=") and (isinstance(rule.value, str | bool) or math.isnan(rule.value)):
        raise ValueError(f"{op} needs a number, got {value!r}")
    return rule


def _value(text: str) -> float | str | bool:
    if text in ("true", "false"):
        return text == "true"
    try:
        return float(text)
    except ValueError:
        return text.strip("\"'")


def succeeds(rules: Sequence[SuccessRule], row: Mapping[str, Any]) -> bool:
    """Return whether a run ended normally and kept every rule; without rules, whether its verdict is good."""
    rules = rules or (parse_rule("verdict"),)
    return row["outcome"] == "ok" and all(rule.kept_by(row) for rule in rules)


def margin(rules: Sequence[SuccessRule], row: Mapping[str, Any]) -> float | None:
    """Return the distance of a row to its nearest limit, as a share of that rule's value; below 0 the rule is broken.

    None without a rule that compares numbers by size.
    """
    found = [_margin(rule, row) for rule in rules]
    known = [one for one in found if one is not None]
    return min(known) if known else None


def _margin(rule: SuccessRule, row: Mapping[str, Any]) -> float | None:
    found, limit = row.get(rule.column), rule.value
    if rule.op in ("==", "!=") or isinstance(found, str | bool) or found is None or isinstance(limit, str):
        return None
    distance = float(found) - limit if rule.op.startswith(">") else limit - float(found)
    return distance / (abs(limit) or 1.0)


@dataclass(frozen=True)
class Proportion:
    """Successes among runs, with the Wilson interval of their probability."""

    successes: int
    runs: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """Successes divided by runs; 0 without a run."""
        return self.successes / self.runs if self.runs else 0.0

    def __str__(self) -> str:
        return f"{self.successes} of {self.runs} ({self.share:.1%}; 95 % interval {self.low:.1%} to {self.high:.1%})"


def proportion(successes: int, runs: int, confidence: float = 0.95) -> Proportion:
    """Return the share of successes with its Wilson interval."""
    if not runs:
        return Proportion(0, 0, 0.0, 1.0)
    interval = binomtest(successes, runs).proportion_ci(confidence, method="wilson")
    return Proportion(successes, runs, float(interval.low), float(interval.high))
