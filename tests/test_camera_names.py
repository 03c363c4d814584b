"""A camera is one folder of bytes, one driver and one record: how many other modules name it."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("evstim", "emulator", "transports", "firmware_protocol")

# The names of each camera, the places where they belong (the folder of its bytes and its record, its driver), and the
# number of other modules that name it, which may only fall.
CAMERAS = {
    "DAVIS346": (r"davis", "davis346", "davis_host", 18),
    "DVXplorer": (r"dvxplorer", "dvxplorer", "dvxplorer_host", 4),
    "Gen 3.1": (r"gen31|silkyevcam_vga|evk3_vga", "gen31", "treuzell_host", 2),
    "GenX320": (r"gen_?x", "genx320", "treuzell_host", 2),
    "EVK4 and Triton2": (r"imx636|evk4|triton|silkyevcam_hd|ueye", "imx636", "treuzell_host", 8),
}


@cache
def code_of(path):
    """The words of a module in one text."""
    return "\n".join(words_of(path))


def words_of(path):
    """The identifiers, imported modules and strings of a module, without its docstrings."""
    tree = ast.parse(path.read_text())
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""
        elif isinstance(node, ast.alias | ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg | ast.keyword):
            yield node.arg or ""
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
            yield node.value


@pytest.mark.parametrize("camera", CAMERAS)
def test_few_modules_name_a_camera(camera):
    names, folder, driver, most = CAMERAS[camera]
    places = (f"firmware_protocol/{folder}", f"emulator/cameras/{folder}.py", f"transports/usb/{driver}.py")
    assert all((ROOT / place).exists() for place in places)
    modules = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    others = [path for path in modules if not any(path.is_relative_to(ROOT / place) for place in places)]
    naming = [str(path.relative_to(ROOT)) for path in others if re.search(names, code_of(path), re.I)]
    assert len(naming) <= most, naming
