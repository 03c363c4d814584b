"""Rigs made in Python of public names: each shipped one, and every part that a rig can have."""

import dataclasses
import typing

import pytest

import evstim
from emulator.rig.top_level import TOP_LEVEL

PUBLIC = {id(value): name for name in evstim.__all__ if isinstance(value := getattr(evstim, name), type)}


def source(value):
    """Return the Python expression that makes a part of a rig, of public names and what differs from the defaults."""
    if isinstance(value, tuple):
        return f"({''.join(source(one) + ', ' for one in value)})"
    if not dataclasses.is_dataclass(value):
        return repr(value)
    fields = [f for f in dataclasses.fields(value) if f.compare]  # not the file that it was loaded from
    given = {f.name: getattr(value, f.name) for f in fields if getattr(value, f.name) != default(f)}
    arguments = ", ".join(f"{name}={source(one)}" for name, one in given.items())
    return f"evstim.{PUBLIC[id(type(value))]}({arguments})"


def default(field):
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def classes_of(annotation):
    """Return the dataclasses that a table of this type can hold, itself and those in it."""
    found = set()
    if dataclasses.is_dataclass(annotation):
        hints = typing.get_type_hints(annotation)
        found = {annotation}.union(*(classes_of(hints[f.name]) for f in dataclasses.fields(annotation)))
    return found.union(*(classes_of(one) for one in typing.get_args(annotation)))


@pytest.mark.parametrize("name", evstim.shipped_rigs())
def test_a_shipped_rig_can_be_made_in_python(name):
    loaded = evstim.load_rig(name)
    made = eval(source(loaded), {"evstim": evstim, "inf": float("inf")})
    assert made == loaded
    assert repr(made) == repr(loaded)


@pytest.mark.parametrize("key", [name for name, key in TOP_LEVEL.items() if key.kinds()])
def test_every_part_of_a_rig_has_a_public_name(key):
    parts = set().union(*(classes_of(cls) for cls in TOP_LEVEL[key].kinds().values()))
    assert parts
    assert [cls.__name__ for cls in parts if id(cls) not in PUBLIC] == []


def camel(kind):
    return "".join(word.capitalize() for word in kind.split("_"))


@pytest.mark.parametrize(("key", "suffix"), [("scene", "Scene"), ("links", "Link"), ("faults", "")])
def test_a_part_has_the_name_of_its_kind(key, suffix):
    for kind, cls in TOP_LEVEL[key].kinds().items():
        assert getattr(evstim, camel(kind) + suffix) is cls
