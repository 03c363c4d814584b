"""Old spellings in rig files: accepted for one version, with a logged warning that names the new spelling."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

__all__ = ["VALUES", "with_new_spellings"]

_LOG = logging.getLogger(__name__)

VALUES: Mapping[tuple[str, str], Mapping[str, str]] = {
    ("run", "method"): {"warped": "hermite", "held": "v2e_exact_filter"},
}
"""New value by old value, for each (table, key). Renamed in version 0.2; to be removed in the version after."""


def with_new_spellings(rig: dict[str, Any]) -> dict[str, Any]:
    """Return a rig's tables with old values replaced by the new ones; the argument stays as it is."""
    for (name, key), renamed in VALUES.items():
        table = rig.get(name)
        old = table.get(key) if isinstance(table, dict) else None
        if isinstance(old, str) and old in renamed:
            _LOG.warning("%s.%s = %r is the old spelling of %r; please change the rig", name, key, old, renamed[old])
            rig = {**rig, name: {**rig[name], key: renamed[old]}}
    return rig
