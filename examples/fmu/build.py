"""Build an FMU of `falling.c` with gcc and the headers of FMPy:  python build.py [2|3]"""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import zipfile
from pathlib import Path

_VARIABLES = ("height_m", "speed_m_s", "thrust_m_s2", "gravity_m_s2", "trouble")
_SOURCE = Path(__file__).with_name("falling.c")
_FMPY = importlib.util.find_spec("fmpy")
_HEADERS = Path(_FMPY.origin or "").parent / "c-code" if _FMPY else Path("fmpy-is-not-installed")


def _attributes(k: int, name: str) -> str:
    causality = "output" if name in ("height_m", "speed_m_s") else "input"
    return f'name="{name}" valueReference="{k}" causality="{causality}" variability="continuous"'


def _start(name: str) -> str:
    return "" if name in ("height_m", "speed_m_s") else ' start="0"'


def _description_2() -> str:
    variables = "".join(
        f"<ScalarVariable {_attributes(k, name)}><Real{_start(name)}/></ScalarVariable>"
        for k, name in enumerate(_VARIABLES)
    )
    return (
        '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="falling" guid="{1}">'
        '<CoSimulation modelIdentifier="falling" canHandleVariableCommunicationStepSize="true"/>'
        f"<ModelVariables>{variables}"
        '<ScalarVariable name="count" valueReference="9" causality="input" variability="discrete">'
        '<Integer start="0"/></ScalarVariable>'
        '</ModelVariables><ModelStructure><Outputs><Unknown index="1"/><Unknown index="2"/></Outputs>'
        "</ModelStructure></fmiModelDescription>"
    )


def _description_3() -> str:
    variables = "".join(f"<Float64 {_attributes(k, name)}{_start(name)}/>" for k, name in enumerate(_VARIABLES))
    return (
        '<?xml version="1.0"?><fmiModelDescription fmiVersion="3.0" modelName="falling" instantiationToken="{1}">'
        '<CoSimulation modelIdentifier="falling" canHandleVariableCommunicationStepSize="true"/>'
        f'<ModelVariables><Float64 name="time" valueReference="10" causality="independent" variability="continuous"/>'
        f"{variables}</ModelVariables><ModelStructure>"
        '<Output valueReference="0"/><Output valueReference="1"/></ModelStructure></fmiModelDescription>'
    )


def _stubs(version: int) -> str:
    """Return C of the functions that falling.c does not have: fmpy loads all functions of FMI."""
    header, own = (_HEADERS / f"fmi{version}Functions.h").read_text(), _SOURCE.read_text()
    names = set(re.findall(rf"fmi{version}\w+TYPE\s+(fmi{version}\w+)\s*;", header))
    return "".join(f"int {name}(void) {{ return 0; }}\n" for name in sorted(names) if f" {name}(" not in own)


def built(folder: Path, version: int) -> Path:
    """Return an FMU of FMI 2 or 3, built in a folder."""
    library, file, rest = (folder / f"falling{version}{suffix}" for suffix in (".so", ".fmu", ".c"))
    rest.write_text(_stubs(version))
    command = ["gcc", "-shared", "-fPIC", "-w", f"-DFMI{version}", f"-I{_HEADERS}"]
    command += [str(_SOURCE), str(rest), "-o", str(library)]
    subprocess.run(command, check=True)
    place, text = ("linux64", _description_2()) if version == 2 else ("x86_64-linux", _description_3())
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        archive.write(library, f"binaries/{place}/falling.so")
    return file


if __name__ == "__main__":
    print(built(Path(), int(sys.argv[1]) if len(sys.argv) > 1 else 3))
