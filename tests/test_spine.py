"""The spine, what one reads first: its size, its imports, and the members of its three interfaces."""

import ast
import tomllib
from pathlib import Path

from firmware_protocol.device.event_device import EventDevice
from transports.link.endpoint import Endpoint
from transports.link.kind import LinkKind

ROOT = Path(__file__).parent.parent
PACKAGES = ("evstim", "emulator", "transports", "firmware_protocol", "laboratory")
PATHS = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
}
MOST_LINES, MOST_MODULES = 20_000, 85

# Modules outside the spine that it may import: values that pass through it, files and sockets.
VALUES = {
    "emulator.geometry.camera", "emulator.threads",
    "firmware_protocol.bounds", "firmware_protocol.compiled", "firmware_protocol.events", "firmware_protocol.frames",
    "firmware_protocol.imu_samples", "firmware_protocol.recordings.part",
    "transports", "transports.connections", "transports.faults.kinds", "transports.faults.script", "transports.needs",
    "transports.network", "transports.output_file", "transports.registry",
}  # fmt: skip


def spine():
    """The modules of the spine, as the import contract in pyproject.toml lists them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (contract,) = (contract for contract in contracts if contract["name"].startswith("The spine imports no"))
    listed = contract["source_modules"]
    assert not [name for name in listed if name not in PATHS]
    return {module for module in PATHS if any(module == name or module.startswith(f"{name}.") for name in listed)}


def imports_of(module):
    """The modules of ours that a module imports anywhere in its text."""
    for node in ast.walk(ast.parse(PATHS[module].read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in PATHS)
        elif isinstance(node, ast.ImportFrom) and node.module in PATHS:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            yield from names & set(PATHS) or {node.module}


def test_the_spine_is_read_in_a_week():
    modules = spine()
    assert len(modules) <= MOST_MODULES
    assert sum(PATHS[module].read_text().count("\n") for module in modules) <= MOST_LINES


def test_the_spine_imports_itself_and_values():
    modules = spine()
    imported = {name: module for module in modules for name in imports_of(module)}
    assert {name: module for name, module in imported.items() if name not in modules | VALUES} == {}
    assert set(imported) >= VALUES, "remove what the spine no longer imports"


def members(kind):
    """The public members that a class and its bases of ours have."""
    names = {name for base in kind.__mro__ if base.__module__ in PATHS for name in vars(base)}
    names |= {name for base in kind.__mro__ if base.__module__ in PATHS for name in base.__annotations__}
    return sorted(name for name in names if not name.startswith("_"))


def test_the_interfaces_are_small():
    assert len(members(EventDevice)) <= 14, members(EventDevice)
    assert len(members(LinkKind)) <= 10, members(LinkKind)
    assert len(members(Endpoint)) <= 12, members(Endpoint)
