"""Settings of numba for processes that only compile: the same code in less time.

The time of a compilation is nearly all in Python, in many small functions. Here it is reduced by

- no search for garbage: a compilation makes millions of objects that live until its end
- no wrapper for calls from Python, for functions that only compiled code calls: numba makes two for each function, and
  optimises them again in each caller
- machine code only for functions that Python calls: the others are linked as LLVM modules
- types of an operation on the same types of numbers and arrays found once, in place of a search in all its versions
- short answers in three small functions of numba that are called millions of times

LLVM's passes are those of any process, so the machine code is the same. A process that runs a rig does not use this
module.
"""

from __future__ import annotations

import gc
from functools import cache
from typing import Any

import numba
from numba.core import codegen, cpu, dispatcher, ir, targetconfig
from numba.core import types as kinds
from numba.core.caching import NullCache

__all__ = ["compile_fast"]

# Of these numba has no types, or they are changed here.
_Dispatcher: Any = dispatcher.Dispatcher
_Library: Any = codegen.JITCodeLibrary
_Context: Any = cpu.CPUContext
_Function: Any = kinds.BaseFunction
_Instruction: Any = ir.Inst
_Options: Any = targetconfig.TargetConfig
_OptionsInUse: Any = targetconfig.ConfigStack
_numba: Any = numba

_TESTED = "0.68."  # these are internals of numba; another version compiles as it does by itself
_NO_WRAPPERS = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_PLAIN = kinds.Number | kinds.Boolean | kinds.Array | kinds.NoneType | kinds.UniTuple


def compile_fast() -> None:
    """Set up numba in this process, whose only task is to compile."""
    gc.disable()
    if not numba.__version__.startswith(_TESTED):
        return
    _leave_out_wrappers()
    _leave_out_machine_code()
    _remember_types()
    _shorten_comparisons()
    _shorten_list_vars()


def _leave_out_wrappers() -> None:
    """Make no wrappers for functions that are compiled for a caller, unless they are cached on disk for Python too."""
    compile_one = _Dispatcher.compile

    def compile_for_caller(self: Any, signature: Any) -> Any:
        if _OptionsInUse.top_or_none() is not None and isinstance(self._cache, NullCache):
            self._compiler.targetoptions.update(_NO_WRAPPERS)
        return compile_one(self, signature)

    _Dispatcher.compile = compile_for_caller


def _leave_out_machine_code() -> None:
    """Generate machine code when Python requests an address, and not for each function that is linked."""
    finish = _Library._finalize_specific

    def resolve(self: Any) -> None:
        if getattr(self, "_compiled_object", None):  # from disk: numba's module is empty, and would stay unloaded
            finish(self)
        else:
            self._codegen._scan_and_fix_unresolved_refs(self._final_module)

    _Library._finalize_specific = resolve
    make = _Context.get_executable

    def executable(self: Any, library: Any, descriptor: Any, environment: Any) -> Any:
        if library.get_pointer_to_function(descriptor.llvm_cpython_wrapper_name):
            return make(self, library, descriptor, environment)
        name = descriptor.qualname.split(".")[-1]  # without its environment: writing that would generate the code
        return _numba._dynfunc.make_function(descriptor.lookup_module(), name, "", 0, environment, (library,))

    _Context.get_executable = executable


def _remember_types() -> None:
    """Keep the result of an operation on plain types with the operation, whose versions are all known by then."""
    find = _Function.get_call_type

    def call_type(self: Any, context: Any, args: Any, named: Any) -> Any:
        if named or not all(isinstance(kind, _PLAIN) for kind in args):
            return find(self, context, args, named)
        known = self.__dict__.setdefault("_evstim_known", {})
        if (found := known.get(args)) is None:
            found = known[args] = find(self, context, args, named)
        return found

    _Function.get_call_type = call_type


def _shorten_comparisons() -> None:
    """Compare only the options that one of two sets; numba's hash is of the names alone."""
    compare = _Options.__eq__

    def equal(self: Any, other: Any) -> Any:
        if self is other:
            return True
        if type(self) is not type(other):
            return compare(self, other)
        names = self._values.keys() | other._values.keys()
        return all(getattr(self, name) == getattr(other, name) for name in names)

    hash_of = cache(lambda kind: hash(tuple(sorted(kind.options))))
    _Options.__eq__ = equal
    _Options.__hash__ = lambda self: hash_of(self.__class__)


def _shorten_list_vars() -> None:
    """Find the variables of an instruction by the type of each part, which is looked up once for each type."""

    @cache
    def is_leaf(kind: Any) -> bool:
        return not issubclass(kind, ir.Var | ir.Inst | list | tuple | dict)

    find = _Instruction._rec_list_vars

    def list_vars(self: Any, value: Any) -> Any:
        if type(value) is ir.Var:
            return [value]
        if type(value) is dict:
            return [one for part in value.values() if not is_leaf(part.__class__) for one in list_vars(self, part)]
        return [] if is_leaf(value.__class__) else find(self, value)

    _Instruction._rec_list_vars = list_vars
