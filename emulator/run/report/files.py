"""Files of a run's report: report.html (one page, nothing to download), report.json and junit.xml.

junit.xml has the verdict in the XML that CI systems read: each rule is a test case (the JUnit schema of Apache Ant).
Until a run has ended, report.html and report.json state that it has no verdict, so that the report of an earlier run
in the same folder is not taken for that of a run that was killed.
"""

from __future__ import annotations

import hashlib
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree

from emulator.report.charts import printable
from emulator.report.page import write_json
from emulator.rig.loading import Rig
from emulator.run.outcome import Judgement
from emulator.run.report.content import SCHEMA, ReportContent, numbers, rig_file
from emulator.run.report.sections import page_of, unfinished_page


def begin_files(rig: Rig, folder: Path, began: datetime) -> None:
    """Write the page and the JSON of a run that has not ended, and remove an earlier junit.xml; raises OSError."""
    text = began.isoformat(timespec="seconds")
    unfinished_page(rig.name, rig.title, text).write(folder / "report.html")
    begun = {"schema": SCHEMA, "verdict": "unfinished", "rig": rig.name, "rig_file": rig_file(rig), "began": text}
    write_json(begun, folder / "report.json")
    (folder / "junit.xml").unlink(missing_ok=True)


def write_report(of: ReportContent, folder: Path) -> list[Path]:
    """Write the three files into a folder that exists; return their paths, the page first. Raises OSError."""
    values = write_json(numbers(of), folder / "report.json")
    digest = hashlib.sha256(values.read_bytes()).hexdigest()
    return [
        page_of(of, digest).write(folder / "report.html"),
        values,
        write_junit(of.rig.name, of.rules, of.result.wall_seconds, folder / "junit.xml"),
    ]


def write_junit(rig: str, judgements: tuple[Judgement, ...], seconds: float, path: Path) -> Path:
    """Write one test suite named after the rig; return the path. XML has no control characters: they become spaces."""
    failed = sum(not one.good for one in judgements)
    counts = {"tests": str(len(judgements)), "failures": str(failed), "errors": "0", "time": f"{seconds:.3f}"}
    suites = ElementTree.Element("testsuites", counts)
    suite = ElementTree.SubElement(suites, "testsuite", {"name": f"evstim {printable(rig)}", **counts})
    for one in judgements:
        name, finding = printable(one.rule), printable(one.finding)
        about = {"classname": f"evstim.{printable(rig)}", "name": name, "time": "0"}
        case = ElementTree.SubElement(suite, "testcase", about)
        if one.good:
            ElementTree.SubElement(case, "system-out").text = finding
        else:
            ElementTree.SubElement(case, "failure", {"message": finding}).text = finding
    ElementTree.ElementTree(suites).write(path, encoding="utf-8", xml_declaration=True)
    return path
