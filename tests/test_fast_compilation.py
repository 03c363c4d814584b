"""Compilation ahead of a run gives the code that numba gives otherwise, in processes of their own."""

import os
import subprocess
import sys

import pytest

_MODULE = """
import math
from numba import njit

@njit(error_model="numpy", _nrt=False)
def helper(x, n):
    total = 0.0
    for k in range(n):
        total += math.sqrt(x + k) / (k + 0.3)
    return min(total, 1e6)

@njit(error_model="numpy", cache=True)
def part(values):
    total = 0.0
    for k in range(len(values)):
        total += helper(values[k], k)
    return total

@njit(error_model="numpy", cache=True)
def entry(values):
    if len(values) == 0:
        raise ValueError("no values")
    return part(values) * helper(values[0], len(values))
"""
_USE = """
import sys
import numpy as np
{before}
if {fast}:
    from emulator.run.fast_compilation import compile_fast
    compile_fast()
from kernels_of_a_test import entry, helper, part
values = np.linspace(0.1, 9.7, 37)
{first}
print(entry(values).hex(), sum(entry.stats.cache_misses.values()))
try:
    entry(values[:0])
except ValueError as error:
    print(error)
{last}
"""
_SYMBOLS = """
from numba.core.registry import cpu_target
for function in helper, part, entry:
    result = next(iter(function.overloads.values()))
    engine = cpu_target.target_context.codegen()._engine
    print(function.__name__, engine.is_symbol_defined(result.fndesc.llvm_cpython_wrapper_name))
"""


_COUNTING = """
from collections import Counter
from numba.core import types
found = Counter()
find = types.BaseFunction.get_call_type

def counted_find(function, context, args, named):
    found[function, args] += 1
    return find(function, context, args, named)

types.BaseFunction.get_call_type = counted_find
"""
_COUNTS = "print(max(found.values()), len(found) > 5)"


@pytest.fixture
def use(tmp_path):
    """Function that calls the entry in a new process, and returns the words that it prints."""
    (tmp_path / "kernels_of_a_test.py").write_text(_MODULE)

    def run(fast, cache="cache", before="", first="", last=""):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / cache), "PYTHONPATH": str(tmp_path)}
        code = _USE.format(fast=fast, before=before, first=first, last=last)
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    return run


def test_results_are_equal_to_the_last_bit_and_the_code_on_disk_is_used(use):
    value, misses = use(False, "other")[0].split()
    assert misses == "1"
    assert use(True) == [f"{value} 1", "no values"]
    assert use(False) == [f"{value} 0", "no values"]


def test_code_from_disk_is_called_by_code_that_is_compiled(use):
    value = use(False, "other")[0].split()[0]
    use(True)
    assert use(True, first="entry._cache.flush()") == [f"{value} 1", "no values"]


def test_only_functions_that_python_calls_have_wrappers(use):
    assert use(True, last=_SYMBOLS)[2:] == ["helper False", "part True", "entry True"]


def test_types_are_found_once(use):
    assert use(True, before=_COUNTING, last=_COUNTS)[2:] == ["1 True"]


def test_options_are_equal_where_numba_finds_them_equal():
    code = """
from numba.core.compiler import Flags
plain, other, same = Flags(), Flags(), Flags()
other.nrt = not other.nrt
same.nrt = same.nrt
kinds = [plain, other, same, 1]
before = [a == b for a in kinds for b in kinds], [hash(one) for one in kinds]
from emulator.run.fast_compilation import compile_fast
compile_fast()
assert before == ([a == b for a in kinds for b in kinds], [hash(one) for one in kinds]), before
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)
