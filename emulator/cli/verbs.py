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


_CLI, _LABORATORY = "emulator.cli", "laboratory.verbs"
_VERBS = {
    "Run and read": {
        "demo": (f"{_CLI}.demo:demo", "Run a rig, read its camera in a second process, and compare every event."),
        "run": (f"{_CLI}.run:run", "Run a rig: render its scene, simulate its sensor, serve its links."),
        "listen": (f"{_CLI}.listen.cameras:verbs", "Read a camera, real or emulated, on USB or on another link."),
        "picture": (f"{_CLI}.picture:picture", "Write a picture or movie of a rig or a recording: light and events."),
        "play": (f"{_CLI}.picture:play", "Show the events of a rig or a recording in the terminal."),
        "doctor": (f"{_CLI}.doctor:doctor", "Show which parts this machine has and lacks, and the command for each."),
    },
    "Rigs": {
        "rigs": (f"{_CLI}.rigs:rigs", "List the rigs that are installed with evstim."),
        "check": (f"{_CLI}.rigs:check", "Check a rig file without running it."),
        "tune": (f"{_CLI}.tune:tune", "Choose the rung of run.quality that runs in real time on this machine."),
        "plan": (f"{_CLI}.plan:plan", "Show the plan of a run: step, effects and expected load."),
        "schema": (f"{_CLI}.rigs:schema", "Print the JSON Schema of rig files, or of reports."),
    },
    "While a rig runs": {
        "fault": (f"{_CLI}.fault:fault", "Inject a fault into a link of a running rig."),
        "trigger": (f"{_CLI}.fault:trigger", "Give the camera of a running rig an edge, or reset its clock."),
        "dynamics": (f"{_CLI}.dynamics:dynamics", "Fly an FMU, and send its poses to a running rig."),
        "vizard": (f"{_CLI}.vizard:vizard", "Run a rig in step with a Basilisk simulation, which sends poses."),
    },
    "Recordings": {
        "record": (f"{_CLI}.record:record", "Record the events of a rig to a file: AEDAT4, EVT3, HDF5, a ROS bag, ..."),
        "info": (f"{_CLI}.info:info", "Show the format and the content of a recording of events."),
        "convert": (f"{_CLI}.convert:convert", "Convert a recording of events to another format."),
        "recover": (f"{_CLI}.convert:recover", "Save the readable part of a recording that was cut."),
    },
    "Measure": {
        "campaign": (f"{_CLI}.campaign:verbs", "Run a rig many times over sampled parameters, and report on all runs."),
        "dataset": (f"{_CLI}.campaign:dataset", "Make sequences of events with truth, over sampled parameters."),
        "accuracy": (f"{_LABORATORY}.accuracy:verbs", "Measure accuracy against speed, beside other simulators."),
        "characterise": (f"{_LABORATORY}.characterise:characterise", "Measure a sensor as a laboratory does."),
        "validate": (f"{_LABORATORY}.validate:validate", "Repeat public measurements of real cameras in simulation."),
        "bench": (f"{_LABORATORY}.bench:verbs", "Measure the speeds that the documentation quotes."),
    },
    "Connect": {
        "v4l2": (f"{_CLI}.v4l2:v4l2", "Show a Prophesee camera on USB as a sensor on Linux's camera interface."),
        "gadget": (f"{_CLI}.gadget:verbs", "Make or remove the USB gadget for a camera on a real cable."),
        "dbc": (f"{_CLI}.listen.can:dbc", "Write the DBC file of a rig's CAN link."),
        "export": (f"{_CLI}.export:export", "Write the packets' definitions for COSMOS, Yamcs, F Prime or Wireshark."),
    },
}
VERBS: Registry[Verb] = Registry(
    "evstim.verbs",
    Verb,
    {name: Verb(name, path, text, group) for group, verbs in _VERBS.items() for name, (path, text) in verbs.items()},
)
"""Verbs by name, in the order of `evstim --help`."""
