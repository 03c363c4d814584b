"""Old names of arguments: accepted for one version, with a warning that names the new one."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

__all__ = ["renamed_argument"]

P = ParamSpec("P")
R = TypeVar("R")


def renamed_argument(old: str, new: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that passes the keyword argument `old` on as `new`, with a DeprecationWarning."""

    def decorator(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def wrapper(*args: Any, **keywords: Any) -> R:
            if old in keywords:
                warnings.warn(f"{old} is now {new}; the old name goes with the next version", DeprecationWarning, 2)
                keywords[new] = keywords.pop(old)
            return function(*args, **keywords)

        return wrapper

    return decorator
