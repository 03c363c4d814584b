"""Registries of records by name: the built-in ones, and those that installed packages give as entry points.

Scenes, links, cameras, faults, formats of recordings and verbs of the command line have one registry each. A built-in
record is the path "module:NAME" of an object, imported at its first look-up, or the record itself where it is plain
data. A package declares a record in its metadata, and is imported at the first look-up of one of its names:

    [project.entry-points."evstim.links"]
    beacon = "my_package.link:BEACON"
"""

from __future__ import annotations

import difflib
import importlib
import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from operator import attrgetter
from typing import Any, Generic, TypeVar, get_args, get_origin

log = logging.getLogger(__name__)

T = TypeVar("T")


class PluginError(Exception):
    """An installed package gives a record that cannot be used; the message contains the package and the error."""


class UnknownName(KeyError):
    """A registry has no record of this name; the message contains the most similar name."""

    def __str__(self) -> str:
        return str(self.args[0])


def imported(path: str) -> Any:
    """Return the object at a path such as "package.module:NAME"."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def unknown(name: str, names: Collection[str]) -> str:
    """Return the message that `name` is none of `names`, with the most similar one."""
    similar = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    remedy = f"did you mean {similar[0]!r}?" if similar else f"known are {', '.join(names)}"
    return f"{name!r} is not known here; {remedy}"


class Registry(Mapping[str, T], Generic[T]):
    """Records by name, each loaded at its first look-up, which raises PluginError for a broken package.

    Parameters
    ----------
    group : of the entry points.
    record : type of the records; `type[Base]` where they are subclasses of a base class.
    built_in : import paths, or records, by name. No package can replace one of these.
    name_of : function that returns the name of a record.
    """

    def __init__(
        self, group: str, record: Any, built_in: Mapping[str, str | T], name_of: Callable[[T], str] = attrgetter("name")
    ) -> None:
        self._group = group
        self._record = record
        self._built_in = built_in
        self._name_of = name_of
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

    @property
    def built_in_names(self) -> Collection[str]:
        """Names that need no package."""
        return self._built_in.keys()

    def usable(self) -> dict[str, T]:
        """Return all records by name; those of broken packages are left out, with one warning."""
        records: dict[str, T] = {}
        for name in self:
            try:
                records[name] = self[name]
            except PluginError as error:
                if name not in self._warned:
                    log.warning("%s", error)
                self._warned.add(name)
        return records

    def imported(self, name: str, path: str) -> Any:
        """Return the object at a path in the record of that name; raises PluginError for a record of a package."""
        if name in self._built_in:
            return imported(path)
        try:
            return imported(path)
        except (Exception, SystemExit) as error:
            origin = _described(self._plugins[name][0], self._group)
            raise PluginError(f"{origin}: {path} cannot be imported: {type(error).__name__}: {error}") from error

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
            record = self._built_in[name]
            return imported(record) if isinstance(record, str) else record
        if name not in self._plugins:
            raise UnknownName(unknown(name, list(self)))
        points = self._plugins[name]
        if len(points) > 1:
            packages = " and ".join(_described(point, self._group) for point in points)
            raise PluginError(f"{packages} have the same name; uninstall all but one")
        return self._of_plugin(points[0])

    def _of_plugin(self, point: EntryPoint) -> T:
        origin = _described(point, self._group)
        try:
            record: T = point.load()
        except (Exception, SystemExit) as error:
            raise PluginError(f"{origin} cannot be loaded: {type(error).__name__}: {error}") from error
        if get_origin(self._record) is type:
            (base,) = get_args(self._record)
            if not (isinstance(record, type) and issubclass(record, base)):
                raise PluginError(f"{origin} must be a subclass of {base.__name__}, and is {record!r}")
        elif not isinstance(record, self._record):
            raise PluginError(f"{origin} must be a {self._record.__name__}, and is {record!r}")
        if (name := self._name_of(record)) != point.name:
            raise PluginError(f"{origin} gives a record of another name, {name!r}")
        return record


def _described(point: EntryPoint, group: str) -> str:
    package = "an unknown package" if point.dist is None else f"package {point.dist.name}"
    return f"entry point {point.name!r} ({point.value}) of {package} in group {group}"
