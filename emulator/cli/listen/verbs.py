"""The commands below `evstim listen`, one for each kind of link; USB is the default."""

from __future__ import annotations

from cyclopts import App

from emulator.cli.listen.usb import listen

__all__ = ["verbs"]

verbs = App(name="listen")
verbs.default(listen)
verbs.command(listen, name="usb", help="Read a DAVIS346 on USB.")
verbs.command("emulator.cli.listen.serial:serial", name="serial", help="Read a camera on a serial line.")
verbs.command("emulator.cli.listen.can:can", name="can", help="Read a camera on a CAN bus.")
