"""Outcomes of tests that show an unmodified client with a camera, collected for docs/matrix.md.

    EVSTIM_MATRIX=docs/device_matrix.json python -m pytest -m guest --timeout 900
    python docs/device_matrix.py

A test declares what it shows beside its assertions, and has that cell of the page if it passes:

    @pytest.mark.shows("davis346", "{driver.name}", "opens", "events")

Camera and client are keys of docs/device_matrix.py. Names in braces are the test's parameters. A run replaces the
outcomes of the tests that it ran, and keeps those of others with their date; a test that never ran is "not run". A test
whose length is chosen records it, `record_property("amount", "100 cycles")`, with its "seconds": its row has these and
the machine.
"""

import datetime
import json
import os
import platform
import re
from pathlib import Path
from typing import Any

__all__ = ["declared", "pytest_itemcollected", "pytest_runtest_logreport", "pytest_sessionfinish"]

FILE = os.environ.get("EVSTIM_MATRIX", "")
PROPERTY = "shows"
REASON_CHARACTERS = 160
MEASURED = ("amount", "seconds")

Row = dict[str, Any]
_rows = {}
_collected = {}


def declared(item):
    """Return what a test declares: of each mark its camera, client and list of columns."""
    parameters = item.callspec.params if hasattr(item, "callspec") else {}
    rows = []
    for mark in item.iter_markers(PROPERTY):
        camera, client, *what = (word.format(**parameters) for word in mark.args)
        rows.append({"camera": camera, "client": client, "what": what})
    return rows


def outcome_of(report):
    """Return "passed", "failed" or "skipped", and the reason in one line; an expected failure is a failure."""
    if report.passed:
        return "passed", ""
    if hasattr(report, "wasxfail"):
        return "failed", str(report.wasxfail)
    if report.skipped and isinstance(report.longrepr, tuple):
        return "skipped", str(report.longrepr[2]).removeprefix("Skipped: ")
    crash = getattr(report.longrepr, "reprcrash", None)
    lines = str(crash.message if crash else report.longrepr).splitlines() or [""]
    return "failed", lines[0][:REASON_CHARACTERS]


def pytest_itemcollected(item):
    """Put the declarations into the reports, which come from other processes where tests run in parallel."""
    if rows := declared(item):
        item.user_properties.append((PROPERTY, rows))
        _collected[item.nodeid] = [row | of_test(item.nodeid, "skipped", "not in the run") for row in rows]


def pytest_runtest_logreport(report):
    """Take the outcome of a test: of its call, or of what failed before or after it."""
    properties = dict(report.user_properties)
    rows = properties.get(PROPERTY)
    if rows is None or (report.when != "call" and report.passed):
        return
    outcome, reason = outcome_of(report)
    measured = {name: properties[name] for name in MEASURED if name in properties}
    measured |= {"machine": machine()} if measured else {}
    _rows[report.nodeid] = [row | of_test(report.nodeid, outcome, reason) | measured for row in rows]


def machine():
    """Return the number of cores and the processor's name, as Linux has it."""
    models = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return f"{os.cpu_count()} cores of an {models[0] if models else platform.machine()}"


def of_test(name, outcome, reason):
    """Return the part of a row that its test gives."""
    date = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
    return {"test": name, "outcome": outcome, "reason": reason, "date": date}


def pytest_sessionfinish():
    """Write the outcomes into the file that EVSTIM_MATRIX names."""
    if FILE and _collected and "PYTEST_XDIST_WORKER" not in os.environ:
        write(Path(FILE), _rows, _collected)


def write(file, rows, collected):
    """Replace in a file the rows of the tests that ran, and keep the others; add those collected that it lacks."""
    kept = [row for row in (json.loads(file.read_text()) if file.exists() else []) if row["test"] not in rows]
    lacking = collected.keys() - rows.keys() - {row["test"] for row in kept}
    added = [*rows.values(), *(collected[name] for name in lacking)]
    merged = kept + [row for test in added for row in test]
    merged.sort(key=lambda row: (row["camera"], row["client"], row["test"], row["what"]))
    lines = ",\n".join(json.dumps(row) for row in merged)
    file.write_text(f"[\n{lines}\n]\n")
