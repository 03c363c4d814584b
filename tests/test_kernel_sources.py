"""Every kernel on disk declares the modules that it is made of: no change of ours leaves stale code in numba's cache.

From each cached function a walk follows all names that it uses, in the syntax trees of the modules: functions that it
calls, constants that are frozen in it, and what those are computed from.
"""

import ast
import gc
import importlib
import re
from functools import cache
from pathlib import Path

import pytest
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

from firmware_protocol.compiled import RULE, entry_of, place_of

ROOT = Path(__file__).parents[1]
OURS = ("emulator", "firmware_protocol", "transports", "laboratory")


def modules_with_kernels():
    for path in sorted(path for room in OURS for path in (ROOT / room).rglob("*.py")):
        if re.search(r"\bnumba|compiled|cached", path.read_text()):
            yield ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def kernels():
    """Return all compiled functions of ours, those that are cached on disk and those that they call."""
    for module in modules_with_kernels():
        importlib.import_module(module)
    # The type, not isinstance: that reads the class of what a weak proxy stands for, which may be gone.
    found = [one for one in gc.get_objects() if issubclass(type(one), Dispatcher)]
    return [one for one in found if is_ours(one.py_func.__module__)]


def is_ours(module):
    return bool(module) and module.split(".")[0] in OURS


class Names(ast.NodeVisitor):
    """The names that a statement loads, and the attributes of each; none of annotations, which are not evaluated."""

    def __init__(self, node):
        self.found = {}
        self.visit(node)

    def visit_Name(self, node):
        if isinstance(node.ctx, ast.Load):
            self.found.setdefault(node.id, set())

    def visit_Attribute(self, node):
        if isinstance(node.value, ast.Name):
            self.found.setdefault(node.value.id, set()).add(node.attr)
        self.generic_visit(node)

    def visit_FunctionDef(self, node):
        for part in (*node.decorator_list, *node.args.defaults, *filter(None, node.args.kw_defaults), *node.body):
            self.visit(part)

    def visit_AnnAssign(self, node):
        if node.value is not None:
            self.visit(node.value)


def statements(body):
    """Yield the statements of a module, and those within its conditions and loops."""
    for node in body:
        yield node
        for inner in ("body", "orelse", "finalbody"):
            if not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
                yield from statements(getattr(node, inner, []))


@cache
def bindings(module):
    """Return what each global name of a module of ours is bound by: statements."""
    place = place_of(module)
    tree = ast.parse((place / "__init__.py" if place.is_dir() else place).read_text())
    bound = {}
    for node in statements(tree.body):
        for name in bound_by(node):
            bound.setdefault(name, []).append(node)
    return bound


def bound_by(node):
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    if isinstance(node, ast.Import | ast.ImportFrom):
        return [alias.asname or alias.name.split(".")[0] for alias in node.names]
    if isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign | ast.For | ast.With):
        return [one.id for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)]
    return []


def walk(module, name, attributes, seen):
    """Add to `seen` every (module, name) of ours that the name `name` of `module` is made of."""
    if (module, name, frozenset(attributes)) in seen or not is_ours(module):
        return
    seen.add((module, name, frozenset(attributes)))
    for node in bindings(module).get(name, ()):
        if isinstance(node, ast.ImportFrom):
            imported = next(one.name for one in node.names if (one.asname or one.name) == name)
            from_import(node.module, imported, attributes, seen)
        elif isinstance(node, ast.Import):
            imported = next(one.name for one in node.names if one.asname == name or one.name.split(".")[0] == name)
            for attribute in attributes:
                walk(imported, attribute, (), seen)
        else:
            for used, of in Names(node).found.items():
                walk(module, used, of, seen)


def from_import(module, name, attributes, seen):
    if not is_ours(module):
        return
    if is_module(f"{module}.{name}"):
        for attribute in attributes:
            walk(f"{module}.{name}", attribute, (), seen)
    else:
        walk(module, name, attributes, seen)


def is_module(name):
    try:
        return bool(place_of(name))
    except ValueError:
        return False


def modules_of(function):
    """Return the modules that a Python function is made of, by the syntax trees."""
    seen = set()
    walk(function.__module__, function.__qualname__.split(".")[0], (), seen)
    return {module for module, *_ in seen}


def undeclared(dispatcher):
    """Return the modules that a cached function is made of and does not declare."""
    made_of = modules_of(dispatcher.py_func)
    places = [place_of(name) for name in (*dispatcher.sources, *RULE)]
    return {module for module in made_of if not any(is_within(place_of(module), place) for place in places)}


def is_within(module, place):
    return module == place or place in module.parents


def name_of(dispatcher):
    return f"{dispatcher.py_func.__module__}.{dispatcher.py_func.__qualname__}"


@pytest.fixture(scope="module")
def cached():
    return [one for one in kernels() if not isinstance(one._cache, NullCache)]


def test_all_code_on_disk_is_made_by_the_one_rule(cached):
    assert len(cached) > 60
    assert [name_of(one) for one in cached if not hasattr(one, "sources")] == []


@pytest.mark.system
def test_every_kernel_declares_all_that_it_is_made_of(cached):
    found = [f"{name_of(one)}: {module}" for one in cached for module in sorted(undeclared(one))]
    assert not found, "\n".join(found)


def test_the_walk_finds_what_kernels_call_and_freeze(cached):
    """The modules of one kernel, found by reading them."""
    shading = next(one for one in cached if name_of(one) == "emulator.scene.terrain.pixel_shading.shade_rows")
    made_of = modules_of(shading.py_func)
    assert {
        "emulator.raster.layout",  # columns that are frozen
        "emulator.photometry.reflection_kernels",  # called
        "emulator.scene.terrain.ground",  # MOMENTS, by way of the boxes
        "emulator.sensor.numerics.compiled",  # options of what it calls
    } <= made_of
    assert "emulator.scene.terrain.raster_terrain" not in made_of  # calls it


def test_a_source_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"'emulator\.rastr' is no module"):
        entry_of("emulator.rastr")
