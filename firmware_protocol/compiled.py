"""Compilation of loops over events, pixels and bits by numba: one rule for all kernels that are cached on disk.

kernel     a loop that other compiled code calls: arrays belong to the caller, so no reference is counted
entry_of   the decorator of functions that Python calls, the only ones that are cached on disk. Its arguments are the
           declared sources: every module here whose functions are called or whose constants are frozen in the code

numba by itself compares only the module of a cached function, not the modules that the function calls. Here a checksum
of all declared sources is part of the version that numba compares before it reads a cached index, so the code is valid
as long as none of these sources changes. An index of other sources is ignored unread, so it may name types that no
longer exist. A module that is missing in the declaration leaves stale code on disk when it changes; a test follows
every entry through the names that it uses and compares them with the declaration.

The code is stored where numba stores it: NUMBA_CACHE_DIR, the folder of the module, XDG_CACHE_HOME or ~/.cache. A user
who can write none of these has a folder below TMPDIR, for which no other user has rights: code from it is executed.
Where there is none either, each process compiles anew.

The functions that an entry calls are local to its machine code. numba by itself leaves them weak: where several codes
define a function of one name, as in a process that compiles an entry and the kernels that it calls, all use the first
definition. Each was optimised with its own callers, so results differed in the last bit between the process that
compiles and one that reads the code from disk.
"""

from __future__ import annotations

import logging
import os
import stat
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from multiprocessing import parent_process
from pathlib import Path
from typing import Any, TypeVar

from llvmlite.binding import Linkage
from numba import config, njit
from numba.core import caching, codegen, compiler
from numba.core.runtime.nrt import rtsys


def checksum_of(*places: Path) -> int:
    """Return the checksum of Python sources: of modules, and of all modules in and below folders."""
    files = {file for place in places for file in (place.rglob("*.py") if place.is_dir() else (place,))}
    return zlib.crc32(b"".join(file.read_bytes() for file in sorted(files)))


def private_folder() -> Path:
    """Return the folder of this user below TMPDIR, made if need be; raises OSError where others may have rights for it.

    It is a folder of this user with mode 0700, and no other user but root can put another one in its place.
    """
    user = os.geteuid()
    folder = Path(os.path.realpath(os.environ.get("TMPDIR") or "/tmp"), f"evstim-{user}")
    for above in folder.parents:
        status = above.stat()
        is_shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not status.st_mode & stat.S_ISVTX
        if is_shared or status.st_uid not in (0, user):
            raise PermissionError(f"other users can replace what is in {above}")
    with suppress(FileExistsError):
        folder.mkdir(0o700)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != user or stat.S_IMODE(status.st_mode) & 0o077:
        raise PermissionError(f"{folder} is no folder of this user alone, with mode 0700")
    return folder


def cache_folder(dispatcher: Any) -> Path | None:
    """Return the folder of an entry's code on disk; None where it has none."""
    path = dispatcher._cache.cache_path
    return path and Path(path)


NO_FOLDER = (
    "compiled kernels cannot be stored, so each process compiles them anew, for a minute or longer: set XDG_CACHE_HOME "
    "to a folder that this user can write"
)


@cache
def _log_no_folder() -> None:
    if parent_process() is None:  # once, not in each process that this program starts
        logging.getLogger(__name__).warning(NO_FOLDER)


if os.path.expanduser("~") == "~":  # numba would make a folder of that name
    os.environ["HOME"] = os.devnull

_Cache: Any = caching.FunctionCache
_config: Any = config


class _EntryCache(_Cache):  # type: ignore[misc]
    """Code of an entry on disk; raises RuntimeError or OSError where no folder can be used."""

    def __init__(self, function: Any, checksum: int) -> None:
        self._is_private, configured = False, _config.CACHE_DIR
        try:
            super().__init__(function)
        except RuntimeError:  # numba has no folder that this user can write
            self._is_private = True
            _config.CACHE_DIR = str(private_folder())
            super().__init__(function)
        finally:
            _config.CACHE_DIR = configured
        self._cache_file._version = f"{self._cache_file._version} {checksum}"

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the code for a signature, or None.

        numba by itself first registers all its functions, which code that is compiled already does not use, and imports
        scipy for it: 0.3 s in each process.
        """
        rtsys.initialize(target)
        with suppress(OSError):
            if self._is_private:
                private_folder()
            return self._load_overload(signature, target)

    def save_overload(self, signature: Any, data: Any) -> None:
        try:
            if self._is_private:
                private_folder()
            super().save_overload(signature, data)
        except OSError:
            _log_no_folder()


def valid_for(checksum: int, dispatcher: Any) -> Any:
    """Return a dispatcher of numba with a cache on disk, whose code is valid for that checksum alone."""
    try:
        dispatcher._cache = _EntryCache(dispatcher.py_func, checksum)
    except (RuntimeError, OSError):
        _log_no_folder()
    return dispatcher


_Library: Any = codegen.JITCodeLibrary
_Compiler: Any = compiler.Compiler


class _EntryLibrary(_Library):  # type: ignore[misc]
    """Code of an entry; the functions that it calls are local to its machine code, not to the module for callers."""

    def _optimize_final_module(self) -> None:
        super()._optimize_final_module()
        self._shared_module = self._final_module.clone()
        for function in self.get_defined_functions():
            if function.linkage == Linkage.external:
                self._shared_module.get_function(function.name).linkage = Linkage.linkonce_odr
            else:
                function.linkage = Linkage.internal


class _EntryCompiler(_Compiler):  # type: ignore[misc]
    """numba's compiler for the entries."""

    def compile_extra(self, function: Any) -> Any:
        self.state.library = _EntryLibrary(self.state.targetctx.codegen(), function.__qualname__)
        self.state.library.enable_object_caching()
        return super().compile_extra(function)


_Function = TypeVar("_Function", bound=Callable[..., Any])

RULE = (__name__,)
"""Sources of every entry, which need no declaration."""

_ROOT = Path(__file__).parents[1]
_COUNTED: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_UNCOUNTED: dict[str, Any] = {**_COUNTED, "_nrt": False}


def kernel(function: _Function) -> _Function:
    """Compile `function` for compiled callers."""
    compiled: _Function = njit(**_UNCOUNTED)(function)
    return compiled


def entry_of(*sources: str, **options: Any) -> Callable[[_Function], _Function]:
    """Return the decorator that compiles functions for Python callers, and caches them on disk.

    With NUMBA_DISABLE_JIT it returns them unchanged. Raises ValueError for a name of no module and no package.

    Parameters
    ----------
    sources : names of modules, and of packages with everything below them: "emulator.raster". The code on disk is valid
        while none of them changes.
    options : of numba.njit, beside nogil=True and error_model="numpy".
    """
    checksum = _checksum(*sources, *RULE)

    def entry(function: _Function) -> _Function:
        dispatcher: Any = njit(**{**_COUNTED, **options}, pipeline_class=_EntryCompiler)(function)
        if dispatcher is function:
            return function
        dispatcher.sources = sources
        compiled: _Function = valid_for(checksum, dispatcher)
        return compiled

    return entry


@cache
def _checksum(*sources: str) -> int:
    return checksum_of(*map(place_of, sources))


def place_of(name: str) -> Path:
    """Return the folder of a package, or the file of a module, by its name; raises ValueError."""
    folder = _ROOT.joinpath(*name.split("."))
    for place in (folder, folder.with_name(f"{folder.name}.py")):
        if place.exists():
            return place
    raise ValueError(f"{name!r} is no module or package beside {_ROOT / 'firmware_protocol'}")
