"""Which faults which link can have, and how a table becomes one: from a rig, or from `evstim fault`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from emulator.rig.link_kinds import LINKS
from emulator.tables.typed_table import Path, TableError, convert_kind, unknown
from transports.faults.kinds import Fault
from transports.link.kind import LinkParameters

__all__ = ["convert_fault", "faults_of", "known_faults"]


def known_faults() -> dict[str, type[Fault]]:
    """Return the types of all faults, by kind."""
    return {kind: fault for link in LINKS.usable().values() for kind, fault in link.faults.items()}


def faults_of(link: LinkParameters) -> Mapping[str, type[Fault]]:
    """Return the faults that a link of these parameters can have, by kind."""
    return LINKS[link.kind].possible_faults(link)


def convert_fault(table: object, links: Sequence[LinkParameters], path: Path) -> Fault:
    """Return a table as a fault of one of `links`, whose name it then has; raises TableError."""
    fault = convert_kind(table, known_faults(), path)
    able = [link.name for link in links if fault.kind in faults_of(link)]
    if not fault.link and len(able) == 1:
        return dataclasses.replace(fault, link=able[0])
    if fault.link in able:
        return fault
    if not able:
        raise TableError(f"no link of this rig can have a fault of kind {fault.kind!r}", (*path, "kind"))
    if not fault.link:
        raise TableError(f"'link' is missing: {', '.join(able)} can all have {fault.kind!r}", (*path, "kind"))
    if fault.link not in [link.name for link in links]:
        raise TableError(unknown(fault.link, [link.name for link in links]), (*path, "link"))
    raise TableError(
        f"link {fault.link!r} cannot have a fault of kind {fault.kind!r}; {', '.join(able)} can", (*path, "link")
    )
