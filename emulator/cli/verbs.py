"""The verbs of the command line, each by the path of its function, so that a command imports only its own modules.

Installed packages add verbs as entry points of the group "evstim.verbs", each a `Verb`.
"""

from __future__ import annotations

from dataclasses import dataclass

from transports.registry import Registry


@dataclass(frozen=True)
class Verb:
    """One verb.

    Attributes
    ----------
    command
        Import path, "module:name", of its function or its cyclopts `App`; imported when it is called. The function
        returns the exit code; `emulator.cli.output` has the codes, the consoles, and the error `Failure`.
    help
        One sentence for `evstim --help`.
    group
        Heading under which `evstim --help` lists it.
    """

    name: str
    command: str
    help: str
    group: str = "From other packages"


_VERBS = {
    "Run and read": {
        "demo": (
            "emulator.cli.demo:demo",
            "Run a rig, read its camera over USB/IP in a second process, and compare every event.",
        ),
        "run": ("emulator.cli.run:run", "Run a rig: render its scene, simulate its sensor, serve its links."),
        "listen": (
            "emulator.cli.listen.cameras:verbs",
            "Read a camera, real or emulated: on USB (the default), a serial line or a CAN bus.",
        ),
        "picture": (
            "emulator.cli.picture:picture",
            "Write a picture or movie of a rig or a recording: its light and its events.",
        ),
        "doctor": (
            "emulator.cli.doctor:doctor",
            "Show which parts this machine has and lacks, with the command that adds each.",
        ),
    },
    "Rigs": {
        "rigs": ("emulator.cli.rigs:rigs", "List the rigs that are installed with evstim."),
        "check": ("emulator.cli.rigs:check", "Check a rig file without running it."),
        "plan": ("emulator.cli.plan:plan", "Show the plan of a run: step, effects and expected load."),
        "schema": ("emulator.cli.rigs:schema", "Print the JSON Schema of rig files, or of reports."),
    },
    "While a rig runs": {
        "fault": ("emulator.cli.fault:fault", "Inject a fault into a link of a running rig."),
        "trigger": ("emulator.cli.fault:trigger", "Give the camera of a running rig an edge, or reset its clock."),
        "dynamics": (
            "emulator.cli.dynamics:dynamics",
            "Fly an FMU: its poses go to a running rig, its inputs come from a file or a CAN bus.",
        ),
        "vizard": (
            "emulator.cli.vizard:vizard",
            "Run a rig in step with a Basilisk simulation, which sends poses and requests images.",
        ),
    },
    "Recordings": {
        "record": (
            "emulator.cli.record:record",
            "Record the events of a rig to a file: AEDAT4, EVT3, HDF5, a ROS bag, ...",
        ),
        "info": ("emulator.cli.info:info", "Show the format and the content of a recording of events."),
        "convert": ("emulator.cli.convert:convert", "Convert a recording of events to another format."),
        "recover": ("emulator.cli.convert:recover", "Save the readable part of a recording that was cut."),
    },
    "Measure": {
        "campaign": (
            "emulator.cli.campaign:verbs",
            "Run a rig many times over sampled parameters, and report on the table of all runs.",
        ),
        "dataset": ("emulator.cli.campaign:dataset", "Make sequences of events with truth, over sampled parameters."),
        "accuracy": (
            "laboratory.verbs.accuracy:verbs",
            "Measure accuracy against speed, where each method fails, and other simulators on the same scenes.",
        ),
        "characterise": (
            "laboratory.verbs.characterise:characterise",
            "Measure a simulated sensor with the methods of a laboratory.",
        ),
        "validate": (
            "laboratory.verbs.validate:validate",
            "Repeat public measurements of real cameras on the simulated sensors.",
        ),
        "bench": ("laboratory.verbs.bench:verbs", "Measure the speeds that the documentation quotes."),
    },
    "Connect": {
        "gadget": (
            "emulator.cli.gadget:verbs",
            "Make or remove the USB gadget for a camera on a real cable, at a machine with a USB device port.",
        ),
        "dbc": ("emulator.cli.listen.can:dbc", "Write the DBC file of a rig's CAN link."),
        "export": (
            "emulator.cli.export:export",
            "Write the packets' definitions for COSMOS, Yamcs, F Prime or Wireshark.",
        ),
    },
}
VERBS: Registry[Verb] = Registry(
    "evstim.verbs",
    Verb,
    {name: Verb(name, path, text, group) for group, verbs in _VERBS.items() for name, (path, text) in verbs.items()},
)
"""Verbs by name, in the order of `evstim --help`."""
