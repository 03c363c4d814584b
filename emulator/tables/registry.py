"""Registries of records by name: the built-in ones, and those that installed packages give as entry points.

A built-in record is imported at its first look-up, and a package at the first look-up of one of its names. A package
declares a record in its metadata, under the name in rigs:

    [project.entry-points."evstim.links"]
    beacon = "my_package.link:BEACON"
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol, TypeVar

log = logging.getLogger(__name__)


class Record(Protocol):
    """Record of a registry."""

    @property
    def name(self) -> str:
        """Its name in rigs."""
        ...


T = TypeVar("T", bound=Record)


class PluginError(Exception):
    """An installed package gives a record that cannot be used; the message contains the package and the error."""


def imported(path: str) -> Any:
    """Return the object at a path such as "package.module:NAME"."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


class Registry(Mapping[str, T]):
    """Records by name, each loaded at its first look-up, which raises PluginError for a broken package.

    Parameters
    ----------
    group
        Of the entry points.
    record
        Type of the records.
    built_in
        Import paths by name. No package can replace one of these.
    """

    def __init__(self, group: str, record: type[Any], built_in: Mapping[str, str]) -> None:
        self._group = group
        self._record = record
        self._built_in = built_in
        self._loaded: dict[str, T] = {}
        self._warned: set[str] = set()

    def __getitem__(self, name: str) -> T:
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def __contains__(self, name: object) -> bool:
        return name in self._built_in or name in self._plugins

    def __iter__(self) -> Iterator[str]:
        return iter([*self._built_in, *self._plugins])

    def __len__(self) -> int:
        return len(self._built_in) + len(self._plugins)

    def usable(self) -> dict[str, T]:
        """Return all records by name; those of broken packages are left out, with one warning."""
        entries: dict[str, T] = {}
        for name in self:
            try:
                entries[name] = self[name]
            except PluginError as error:
                if name not in self._warned:
                    log.warning("%s", error)
                self._warned.add(name)
        return entries

    @cached_property
    def _plugins(self) -> dict[str, list[EntryPoint]]:
        """Entry points by name; one name from two packages is an error, raised at its look-up."""
        plugins: dict[str, list[EntryPoint]] = {}
        for point in entry_points(group=self._group):
            if point.name in self._built_in:
                log.warning("%s is not used: %r is built in", _described(point, self._group), point.name)
            elif point not in plugins.setdefault(point.name, []):
                plugins[point.name].append(point)
        return plugins

    def _load(self, name: str) -> T:
        if name in self._built_in:
            record: T = imported(self._built_in[name])
            return record
        points = self._plugins[name]
        if len(points) > 1:
            all_of_them = " and ".join(_described(point, self._group) for point in points)
            raise PluginError(f"{all_of_them} have the same name; uninstall all but one")
        return self._of_plugin(points[0])

    def _of_plugin(self, point: EntryPoint) -> T:
        description = _described(point, self._group)
        try:
            record: T = point.load()
        except (Exception, SystemExit) as error:
            raise PluginError(f"{description} cannot be loaded: {type(error).__name__}: {error}") from error
        if not isinstance(record, self._record):
            raise PluginError(f"{description} must be a {self._record.__name__}, and is {record!r}")
        if record.name != point.name:
            raise PluginError(f"{description} gives a record of another name, {record.name!r}")
        return record


def _described(point: EntryPoint, group: str) -> str:
    package = "an unknown package" if point.dist is None else f"package {point.dist.name}"
    return f"entry point {point.name!r} ({point.value}) of {package} in group {group}"
