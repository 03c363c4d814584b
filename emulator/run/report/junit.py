"""A verdict in the XML that CI systems read: each rule is a test case (the JUnit schema of Apache Ant)."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from emulator.run.verdict import Judgement

__all__ = ["write_junit"]


def write_junit(rig: str, judgements: tuple[Judgement, ...], seconds: float, path: Path) -> Path:
    """Write one test suite named after the rig; return the path."""
    failed = sum(not one.good for one in judgements)
    counts = {"tests": str(len(judgements)), "failures": str(failed), "errors": "0", "time": f"{seconds:.3f}"}
    suites = ElementTree.Element("testsuites", counts)
    suite = ElementTree.SubElement(suites, "testsuite", {"name": f"evstim {rig}", **counts})
    for one in judgements:
        case = ElementTree.SubElement(suite, "testcase", {"classname": f"evstim.{rig}", "name": one.rule, "time": "0"})
        if one.good:
            ElementTree.SubElement(case, "system-out").text = one.told
        else:
            ElementTree.SubElement(case, "failure", {"message": one.told}).text = one.told
    ElementTree.ElementTree(suites).write(path, encoding="utf-8", xml_declaration=True)
    return path
