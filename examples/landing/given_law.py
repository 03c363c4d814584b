"""A law of the user's own, FILE.py:NAME, in the place of the pilot's: loaded, called and judged within bounds.

NAME is a function, or a class that is created without arguments and called. It receives a `LawInput` in each turn and
returns the acceleration that it wants, (east, north, up), m/s2, gravity's not included: (0, 0, 1.62) hovers. A law that
raises, returns anything but three numbers of at most 32 m/s2, or does not return within two seconds, has failed and is
not called again. docs/landing.md has an example and the steps to a better one.
"""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import TypeVar

import numpy as np
from vehicle import Vector

__all__ = ["GivenLaw", "LawFailed", "LawInput"]

_CALL_S, _LOAD_S = 2.0, 60.0
_MOST_M_S2 = 32.0  # a command's frame on the bus has room for it
_MOST_TEXT = 160
_MODULE = "given_law_of_user"

Result = TypeVar("Result")


@dataclass(frozen=True)
class LawInput:
    """State from navigation, predicted for the time at which the command of this turn acts.

    Attributes
    ----------
    t_s : that time, s since the start.
    position_m : place beside the site and height above it, (east, north, up), (3,).
    velocity_m_s : (3,), in the same axes.
    attitude : newest, unit quaternion world from body, scalar first, (4,).
    position_sigma_m, velocity_sigma_m_s : 1 sigma of each axis by the filter, (3,).
    turn_s : time from one command to the next, s.
    """

    t_s: float
    position_m: Vector
    velocity_m_s: Vector
    attitude: Vector
    position_sigma_m: Vector
    velocity_sigma_m_s: Vector
    turn_s: float


class LawFailed(Exception):
    """A law cannot be loaded, or has failed; the message is the predicate of a sentence about it."""


class GivenLaw:
    """A law of a file, called in a thread of its own, so that one that hangs does not stop the flight computer.

    Parameters
    ----------
    text : FILE.py:NAME. Raises LawFailed, with the remedy, where it cannot be loaded.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        file, _, self._name = text.rpartition(":")
        self._path = Path(file).resolve()
        if not self._name.isidentifier() or self._path.suffix != ".py":
            raise LawFailed("is not FILE.py:NAME: give a file and the law's name in it, such as simple_law.py:Law")
        if not self._path.is_file():
            raise LawFailed(f"names no file: give the path of a file that exists, {self._path} does not")
        self._law: Callable[[LawInput], object] = self._within(_LOAD_S, self._loaded)

    def __call__(self, state: LawInput) -> Vector:
        """Return the acceleration that the law wants, (3,), m/s2; raises LawFailed."""
        return self._within(_CALL_S, lambda: _acceleration(self._law(state)))

    def _within(self, seconds: float, call: Callable[[], Result]) -> Result:
        """Return the result of a call; raises LawFailed for any exception of it, and when it takes longer."""
        results: list[Result] = []
        failures: list[LawFailed] = []

        def work() -> None:
            try:
                results.append(call())
            except LawFailed as failure:
                failures.append(failure)
            except BaseException as error:  # noqa: BLE001  a law may raise anything, SystemExit too
                failures.append(LawFailed(f"raised {self._described(error)}"))

        thread = Thread(target=work, daemon=True)
        thread.start()
        thread.join(seconds)
        if failures:
            raise failures[0]
        if not results:
            raise LawFailed(f"did not return within {seconds:g} s")
        return results[0]

    def _described(self, error: BaseException) -> str:
        """Return kind and message of an error, and the line of the law's file that it came from."""
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if frame.filename == str(self._path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        message = " ".join(str(error).split())[:_MOST_TEXT]
        return f"{type(error).__name__}: {message}" + (f", in line {line} of {self._path.name}" if line else "")

    def _loaded(self) -> Callable[[LawInput], object]:
        spec = importlib.util.spec_from_file_location(_MODULE, self._path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[_MODULE] = module  # dataclasses of the file look for their module there
        sys.path.append(str(self._path.parent))  # for what the file imports from beside it
        spec.loader.exec_module(module)
        if not hasattr(module, self._name):
            names = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == _MODULE]
            choice = f"give a name that it defines: {', '.join(names)}" if names else "it defines none"
            raise LawFailed(f"names nothing in {self._path.name}: {choice}")
        law = getattr(module, self._name)
        if isinstance(law, type):
            law = law()
        if not callable(law):
            raise LawFailed("cannot be called: give a function, or a class with a method __call__(self, state)")
        callable_law: Callable[[LawInput], object] = law
        return callable_law


def _acceleration(value: object) -> Vector:
    """Return what a law returned as an array, (3,); raises LawFailed."""
    shown = " ".join(repr(value).split())[:_MOST_TEXT]
    try:
        command = np.array(value, np.float64)
    except (TypeError, ValueError):
        command = np.empty(0)
    if command.shape != (3,) or not np.isfinite(command).all():
        raise LawFailed(f"returned {shown}, not three finite numbers (east, north, up)")
    if np.abs(command).max() > _MOST_M_S2:
        raise LawFailed(f"returned {shown}, beyond {_MOST_M_S2:g} m/s2")
    return command
