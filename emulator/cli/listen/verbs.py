"""The commands below `evstim listen`, one for each kind of link; USB is the default."""

from __future__ import annotations

from cyclopts import App

from emulator.cli.listen.usb import listen
from emulator.rig.kinds import LINKS
from transports.link.kind import Listener

__all__ = ["verbs"]


def _listeners() -> dict[str, Listener]:
    """Return the listeners of all kinds of links by verb; where two have the same verb, that of the first."""
    listeners = [kind.listener for kind in LINKS.usable().values() if kind.listener is not None]
    return {one.verb: one for one in reversed(listeners)}


verbs = App(name="listen")
verbs.default(listen)
for _verb, _listener in _listeners().items():
    verbs.command(_listener.path, name=_verb, help=_listener.help)
