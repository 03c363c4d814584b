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

fastmath={"contract"} allows a * b + c to be rounded once, which is faster and more accurate. LLVM would use that where
it chooses instructions, by the target: of two products in a sum, of a product with a second use, and in the remainder
of a vector loop the choice of AVX2 differs from that of AVX-512, and event times by 1 us. So here `fused` chooses, in
code that is the same for every processor, and takes the permission away. What is left is IEEE arithmetic, which LLVM
keeps to the bit, whatever it widens or moves. A processor without such an instruction calls fmaf: slow, the same bits.

numba lets a function without fastmath inherit that of the caller for which it is compiled first: results differed with
the order of compilation. Here callees inherit none, and what numba's own functions get is taken from them.
"""

from __future__ import annotations

import logging
import os
import re
import stat
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from multiprocessing import parent_process
from pathlib import Path
from typing import Any, TypeVar

import llvmlite.binding as llvm
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


_VALUE = r"%(?:[\w.$-]+|\"[^\"]*\")"
_PRODUCT = re.compile(rf"({_VALUE}) = fmul contract \w+ (\S+), (\S+)")
_SUM = re.compile(rf"({_VALUE}) = f(add|sub) contract (float|double) (\S+), ([^\s,]+)")
_PERMISSION = re.compile(r"(?m)^(  .*) contract ")
_WIDTHS = {"float": "f32", "double": "f64"}


def fused(code: str) -> str:
    """Return a module of LLVM with each sum of a product that may be rounded once as one operation.

    Of two products the left one is fused, and none that has another use. Nothing else may be rounded once any more.
    """
    functions = code.split("\ndefine ")
    for number, function in enumerate(functions):
        uses = Counter(re.findall(_VALUE, function))  # and definitions
        factors = {name: (a, b) for name, a, b in _PRODUCT.findall(function) if uses[name] == 2}

        def fuse(match: re.Match[str]) -> str:
            name, operation, width, x, y = match.groups()
            if x not in factors and y not in factors:  # noqa: B023
                return match[0]
            (a, b), c = (factors[x], y) if x in factors else (factors[y], x)  # noqa: B023
            negation = ""
            if operation == "sub":
                negated = f'{name[:-1]}-"' if name.endswith('"') else f"{name}-"
                negation = f"{negated} = fneg {width} {c if x in factors else a}\n  "  # noqa: B023
                a, c = (a, negated) if x in factors else (negated, c)  # noqa: B023
            operands = f"{width} {a}, {width} {b}, {width} {c}"
            return f"{negation}{name} = call {width} @llvm.fma.{_WIDTHS[width]}({operands})"

        functions[number] = _SUM.sub(fuse, function)
    code = _PERMISSION.sub(r"\1 ", "\ndefine ".join(functions))
    needed = [width for width, name in _WIDTHS.items() if f"@llvm.fma.{name}(" in code]
    return "\n".join([code, *(f"declare {w} @llvm.fma.{_WIDTHS[w]}({w}, {w}, {w})" for w in needed)])


class _KernelLibrary(_Library):  # type: ignore[misc]
    """Code of a kernel."""

    def add_llvm_module(self, module: Any) -> None:
        """Add a module, with its sums of products fused."""
        if " contract " in str(module):
            # In registers instead of memory, by passes that see the instructions of no particular processor.
            target = llvm.Target.from_default_triple().create_target_machine()
            builder = llvm.create_pass_builder(target, llvm.create_pipeline_tuning_options())
            passes = llvm.create_new_function_pass_manager()
            passes.add_sroa_pass()
            passes.add_instruction_combine_pass()
            for function in module.functions:
                passes.run(function, builder)
            code, name = fused(str(module)), module.name
            module = llvm.parse_assembly(code)
            module.name = name
        super().add_llvm_module(module)


class _EntryLibrary(_KernelLibrary):
    """Code of an entry; the functions that it calls are local to its machine code, not to the module for callers."""

    _final_module: Any

    def _optimize_final_module(self) -> None:
        code, name = str(self._final_module), self._final_module.name
        if " contract " in code:
            self._final_module = llvm.parse_assembly(_PERMISSION.sub(r"\1 ", code))
            self._final_module.name = name
        super()._optimize_final_module()
        self._shared_module = self._final_module.clone()
        for function in self.get_defined_functions():
            if function.linkage == llvm.Linkage.external:
                self._shared_module.get_function(function.name).linkage = llvm.Linkage.linkonce_odr
            else:
                function.linkage = llvm.Linkage.internal


class KernelCompiler(_Compiler):  # type: ignore[misc]
    """numba's compiler for kernels that allow a * b + c to be rounded once."""

    library: type[_KernelLibrary] = _KernelLibrary

    def compile_extra(self, function: Any) -> Any:
        """Compile a function."""
        self.state.library = self.library(self.state.targetctx.codegen(), function.__qualname__)
        self.state.library.enable_object_caching()
        self.state.flags.discard("fastmath")  # the context has it, for this function alone
        return super().compile_extra(function)


class _EntryCompiler(KernelCompiler):
    """numba's compiler for the entries."""

    library = _EntryLibrary


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
