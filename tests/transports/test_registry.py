"""Registries: built-in records, those of installed packages, and packages that are broken."""

import logging
import sys
from dataclasses import dataclass
from operator import attrgetter

import pytest

from transports.registry import PluginError, Registry, UnknownName


@dataclass(frozen=True)
class Kind:
    name: str


BUILT_IN = Kind("brick")


def install(folder, package, points, module="", group="test.kinds"):
    """Write a package of one module, with entry points, as pip would install it."""
    (folder / f"{package}.py").write_text(module)
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    lines = [f"{name} = {package}:{value}" for name, value in points.items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]) + "\n")


@pytest.fixture
def site(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(sys.modules, "registry_home", sys.modules[__name__])
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("straw_")]:
        del sys.modules[name]


def registry():
    return Registry("test.kinds", Kind, {"brick": "registry_home:BUILT_IN"})


KIND = "from registry_home import Kind\nSTRAW = Kind('straw')\n"


def test_a_built_in_record_and_one_of_a_package(site):
    install(site, "straw_good", {"straw": "STRAW"}, KIND)
    kinds = registry()
    assert list(kinds) == ["brick", "straw"]
    assert "straw_good" not in sys.modules  # imported when it is asked for
    assert kinds["brick"] is BUILT_IN
    assert kinds["straw"] == Kind("straw")
    assert len(kinds) == len(kinds.usable()) == 2


def test_a_name_that_nobody_has(site):
    assert "straw" not in registry()
    with pytest.raises(UnknownName, match="'brik' is not known here; did you mean 'brick'"):
        registry()["brik"]
    assert registry().get("straw") is None


@pytest.mark.parametrize(
    ("module", "value", "told"),
    [
        ("import no_such_module", "STRAW", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("", "STRAW", "AttributeError"),
        ("raise RuntimeError('no camera')", "STRAW", "RuntimeError: no camera"),
        ("raise SystemExit(3)", "STRAW", "SystemExit: 3"),
        ("STRAW = 7", "STRAW", "must be a Kind, and is 7"),
        ("from registry_home import Kind\nSTRAW = Kind('hay')", "STRAW", "another name, 'hay'"),
    ],
)
def test_a_broken_package_is_named_and_hurts_nobody_else(site, caplog, module, value, told):
    install(site, "straw_broken", {"straw": value}, module)
    kinds = registry()
    assert kinds["brick"] is BUILT_IN
    with pytest.raises(PluginError, match=r"'straw' \(straw_broken:STRAW\) of package straw_broken") as error:
        kinds["straw"]
    assert told in str(error.value)
    with caplog.at_level(logging.WARNING):
        assert list(kinds.usable()) == list(kinds.usable()) == ["brick"]
    assert len(caplog.records) == 1


def test_two_packages_with_one_name_are_both_named(site):
    install(site, "straw_one", {"straw": "STRAW"}, KIND)
    install(site, "straw_two", {"straw": "STRAW"}, KIND)
    with pytest.raises(PluginError, match=r"straw_one.*straw_two|straw_two.*straw_one"):
        registry()["straw"]


def test_no_package_replaces_a_built_in_record(site, caplog):
    install(site, "straw_thief", {"brick": "STRAW"}, KIND)
    kinds = registry()
    assert list(kinds) == ["brick"]
    assert kinds["brick"] is BUILT_IN
    assert "'brick' is built in" in caplog.text


class Base:
    kind = ""


def test_records_that_are_classes_or_stand_in_the_registry_itself(site):
    module = "from registry_home import Base\nclass Straw(Base):\n    kind = 'straw'\nHAY = Base()\n"
    install(site, "straw_class", {"straw": "Straw", "hay": "HAY"}, module)
    kinds = Registry("test.kinds", type[Base], {"": Base}, attrgetter("kind"))
    assert kinds[""] is Base
    assert issubclass(kinds["straw"], Base)
    with pytest.raises(PluginError, match="must be a subclass of Base"):
        kinds["hay"]


def test_a_path_in_a_record_of_a_broken_package(site):
    install(site, "straw_good", {"straw": "STRAW"}, KIND)
    assert registry().imported("straw", "straw_good:Kind") is Kind
    with pytest.raises(PluginError, match="straw_good:build cannot be imported"):
        registry().imported("straw", "straw_good:build")
    with pytest.raises(AttributeError):
        registry().imported("brick", "registry_home:build")
