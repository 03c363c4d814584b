"""The process of an FMU: its machine code runs here, so that its crash is only a missing answer.

first message    {"file", "folder": to unpack it, "start": {variable: value}, "outputs", "inputs"}
each later one   (t_s, step_s, {variable: value}): set inputs, do one step
answers          ("ok", values of the outputs) | ("wrong", the FMU cannot be used so) | ("failed", a call failed)

It ends when the other side closes the connection.
"""

from __future__ import annotations

import importlib
import os
import signal
import zipfile
import zlib
from collections.abc import Iterable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

_KINDS = {"2.0": "Real", "3.0": "Float64"}
_DESCRIPTION = "modelDescription.xml"
_MOST_FILES = 10_000
_MOST_MIB = 1024  # unpacked
_MOST_DESCRIPTION_MIB = 64  # it is read as a whole, and its tree takes many times as much
_SMALLER = "Export it without sources, documentation and unused resources, or get it from its maker again"


class _Wrong(Exception):
    """The FMU cannot be used with this mapping."""


def serve(connection: Connection) -> None:
    """Answer until the other side closes the connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(2, 1)  # output of an FMU must not mix with the command's result
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        try:
            _serve(connection, connection.recv())
        except _Wrong as error:
            connection.send(("wrong", str(error)))
        except EOFError:
            pass
        except Exception as error:  # noqa: BLE001 - fmpy raises plain Exception for all errors of an FMU
            connection.send(("failed", str(error)))


def _serve(connection: Connection, setup: dict[str, Any]) -> None:
    fmpy = importlib.import_module("fmpy")
    description = _description(fmpy, setup["file"])
    references = _references(description, {*setup["outputs"], *setup["inputs"], *setup["start"]})
    try:
        fmpy.extract(setup["file"], unzipdir=setup["folder"])
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise _Wrong(f"is damaged: {str(error)[:300] or 'it ends too soon'}") from error
    unit = fmpy.instantiate_fmu(setup["folder"], description, fmi_type="CoSimulation")
    is_3 = description.fmiVersion.startswith("3")
    get, put = (unit.getFloat64, unit.setFloat64) if is_3 else (unit.getReal, unit.setReal)
    outputs = [references[name] for name in setup["outputs"]]

    def set_variables(values: dict[str, float]) -> None:
        if values:
            put([references[name] for name in values], list(values.values()))

    set_variables(setup["start"])
    if not is_3:
        unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.exitInitializationMode()
    while True:
        connection.send(("ok", list(get(outputs)) if outputs else []))
        t_s, step_s, inputs = connection.recv()
        set_variables(inputs)
        unit.doStep(currentCommunicationPoint=t_s, communicationStepSize=step_s)


def _description(fmpy: Any, file: str) -> Any:
    """Return the model description; raises _Wrong unless it is a co-simulation FMU for this machine."""
    _check_size(file)
    try:
        description = fmpy.read_model_description(file)
    except Exception as error:
        raise _Wrong(f"is not a valid FMU: {str(error)[:300]}") from error
    if description.fmiVersion not in _KINDS:
        raise _Wrong(f"is of FMI {description.fmiVersion}: evstim takes {' and '.join(_KINDS)}")
    if description.coSimulation is None:
        raise _Wrong("has no co-simulation, only model exchange: export it with its solver")
    machine = {fmpy.platform_tuple if description.fmiVersion.startswith("3") else fmpy.platform, fmpy.platform}
    supported = fmpy.supported_platforms(file)
    if not machine & set(supported):
        raise _Wrong(
            f"has no machine code for {' or '.join(sorted(machine))}, only for {', '.join(supported) or 'none'}"
        )
    return description


def _check_size(file: str) -> None:
    """Raise _Wrong unless the file is an archive of a size that an FMU needs: a few KiB may unpack to any size.

    The sizes are those that the archive declares; zipfile unpacks no more than these.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, NotImplementedError) as error:
        raise _Wrong(f"is not an FMU: it is no ZIP archive ({error})") from error
    if len(entries) > _MOST_FILES:
        raise _Wrong(f"has {len(entries)} files: at most {_MOST_FILES} are unpacked. {_SMALLER}")
    _check_mib("unpacks to", sum(entry.file_size for entry in entries), _MOST_MIB)
    description = sum(entry.file_size for entry in entries if entry.filename == _DESCRIPTION)
    _check_mib(f"has a {_DESCRIPTION} of", description, _MOST_DESCRIPTION_MIB)


def _check_mib(name: str, size: int, most_mib: int) -> None:
    if size > most_mib << 20:
        raise _Wrong(f"{name} {size / (1 << 20):.0f} MiB: at most {most_mib} MiB are unpacked. {_SMALLER}")


def _references(description: Any, used: Iterable[str]) -> dict[str, int]:
    variables = {variable.name: variable for variable in description.modelVariables}
    for name in used:
        if name not in variables:
            raise _Wrong(f"has no variable {name!r}; it has {', '.join(list(variables)[:20])}")
        if variables[name].type != (kind := _KINDS[description.fmiVersion]):
            raise _Wrong(f"has {name!r} as {variables[name].type}: variables of a pose and inputs must be {kind}")
    return {name: variables[name].valueReference for name in used}
