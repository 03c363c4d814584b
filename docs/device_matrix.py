"""Write matrix.md, cameras and unmodified clients, from the outcomes of tests: python docs/device_matrix.py

The outcomes are in device_matrix.json, written by a run of the tests (see tests/shown.py). A camera is one record of
CAMERAS, a client one of CLIENTS; both the page and the outcomes are in the repository, and a test keeps them together.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PAGE = Path(__file__).with_name("matrix.md")
OUTCOMES = Path(__file__).with_name("device_matrix.json")

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """A capability: the heading of its row, and the word of a cell whose test passed."""

    heading: str
    shown: str = "shown"


COLUMNS = {
    "opens": Column("opens"),
    "events": Column("events", "exact"),
    "frames": Column("frames", "exact"),
    "imu": Column("IMU", "exact"),
    "triggers": Column("triggers", "exact"),
    "settings": Column("settings changed"),
    "unplugged": Column("unplugged"),
    "plugged again": Column("plugged again"),
    "cycles": Column("opened often"),
}


@dataclass(frozen=True)
class Client:
    """A program of others: its name and version."""

    name: str
    version: str = ""

    def __str__(self) -> str:
        return f"{self.name} {self.version}".strip()


CLIENTS = {
    "dv2": Client("dv-processing", "2.0.4"),
    "dv1": Client("dv-processing (libcaer inside)", "1.7.9"),
    "nd": Client("neuromorphic_drivers", "0.18.2"),
    "eventcv": Client("EventCV (neuromorphic_drivers 0.17 inside)", "1.0.8"),
    "libcaer": Client("libcaer", "3.3.15"),
    "openeb": Client("OpenEB (HAL and Treuzell plugin)", "5.1.1"),
    "openeb_v4l2": Client("OpenEB (HAL and V4L2 plugin)", "5.1.1"),
    "v4l2ctl": Client("v4l2-ctl", "1.22.1"),
    "aravis": Client("Aravis", "of Debian, 0.8"),
    "viva": Client("viva-genicam", "0.10.0"),
    "linux": Client("Linux kernel and Debian's usbip"),
}


@dataclass(frozen=True)
class Camera:
    """A camera of the page.

    Attributes
    ----------
    name
        Heading of its table.
    clients
        Keys of CLIENTS in the order of the rows.
    lacks
        Columns that the camera does not have.
    limits
        By client and column, the reason why the client cannot do it with any such camera.
    remarks
        By client and column, a note to what is shown.
    """

    name: str
    clients: tuple[str, ...]
    lacks: tuple[str, ...] = ()
    limits: Mapping[tuple[str, str], str] = field(default_factory=dict)
    remarks: Mapping[tuple[str, str], str] = field(default_factory=dict)


_KERNEL_ONLY = dict.fromkeys(
    [("linux", column) for column in ("events", "frames", "imu", "triggers", "settings", "cycles")],
    "the kernel lists and attaches the camera; it does not read it",
)
_NO_PLUGIN = "the maker's own plug-in is not public; OpenEB's own driver is given the camera's vendor and product"
_SILKY_AND_IDS = {("openeb", "opens"): _NO_PLUGIN}
_IMX636_LACKS = ("frames", "imu")

CAMERAS = {
    "davis346": Camera(
        "DAVIS346",
        ("dv2", "dv1", "nd", "libcaer", "linux"),
        limits=_KERNEL_ONLY,
        remarks={
            ("nd", "triggers"): "the driver has no setting for the detector of the external input; the test writes "
            "its registers beside the driver",
            ("nd", "settings"): "a change of the region of interest stops the frames; the test starts them "
            "beside the driver",
            ("dv2", "settings"): "without the three calls that lose data or do not return, "
            "see [drivers](cameras.md#changed-while-streaming)",
        },
    ),
    "davis240c": Camera("DAVIS240C", ("dv2", "dv1", "libcaer")),
    "evk4": Camera("Prophesee EVK4 HD", ("nd", "eventcv", "openeb"), lacks=_IMX636_LACKS),
    "silkyevcam_hd": Camera("CenturyArks SilkyEvCam HD", ("nd", "openeb"), _IMX636_LACKS, remarks=_SILKY_AND_IDS),
    "silkyevcam_hd_lite": Camera(
        "CenturyArks SilkyEvCam HD Lite", ("nd", "openeb"), _IMX636_LACKS, remarks=_SILKY_AND_IDS
    ),
    "ueye_xcp_e": Camera("IDS uEye XCP-E", ("nd", "openeb"), _IMX636_LACKS, remarks=_SILKY_AND_IDS),
    "ueye_xls_e": Camera("IDS uEye XLS-E", ("nd", "openeb"), _IMX636_LACKS),
    "evk3_hd": Camera("Prophesee EVK3 HD", ("nd", "openeb"), _IMX636_LACKS),
    "dvxplorer": Camera(
        "DVXplorer",
        ("dv2", "dv1", "nd", "libcaer"),
        lacks=("frames",),
        remarks={
            ("nd", "imu"): "the driver exchanges the first two axes of the gyroscope; the test puts them back",
            ("nd", "triggers"): "the driver has no setting for the detector; the test writes its registers "
            "beside the driver",
        },
    ),
    "dvxplorer_micro": Camera(
        "DVXplorer Micro (firmware 10)",
        ("dv2", "dv1", "nd"),
        lacks=("frames", "triggers"),
        limits={
            ("dv1", "opens"): "it requests a reset of the time, which libcaer refuses for a CX3, real ones included",
            ("nd", "opens"): "it has no reader of the 32-bit words",
        },
        remarks={("dv2", "imu"): "values; the library stamps a sample when it arrives"},
    ),
    "dvxplorer_micro_firmware9": Camera(
        "DVXplorer Micro (firmware 9)", ("libcaer",), lacks=("frames", "triggers", "imu")
    ),
    "silkyevcam_vga": Camera(
        "SilkyEvCam VGA",
        ("nd",),
        lacks=_IMX636_LACKS,
        limits={
            ("nd", "triggers"): "the driver has no setting for the input",
            ("nd", "cycles"): "the driver does not stop the camera when it is closed, and its process may abort",
        },
        remarks={
            (
                "nd",
                "settings",
            ): "it writes a value in mV where the register has a code; a real camera gets the same word"
        },
    ),
    "evk3_vga": Camera("Prophesee EVK3 VGA", ("openeb",), _IMX636_LACKS),
    "genx320": Camera(
        "Prophesee GenX320 (board with a CX3)",
        ("openeb", "nd"),
        lacks=_IMX636_LACKS,
        limits={("nd", "opens"): "it has no driver for this sensor"},
    ),
    "evk4_v4l2": Camera("IMX636 on V4L2", ("openeb_v4l2", "v4l2ctl"), lacks=_IMX636_LACKS),
    "genx320_v4l2": Camera("GenX320 on V4L2", ("openeb_v4l2", "v4l2ctl"), lacks=_IMX636_LACKS),
    "triton2": Camera(
        "LUCID Triton2 EVS (GigE Vision)",
        ("nd", "aravis", "viva"),
        lacks=_IMX636_LACKS,
        remarks={
            (client, column): "its address changes, which is how a network camera is lost and found"
            for client in ("nd", "aravis")
            for column in ("unplugged", "plugged again")
        },
    ),
}

TABLES = (
    ("davis346",),
    ("davis240c",),
    ("evk4",),
    ("silkyevcam_hd", "silkyevcam_hd_lite", "ueye_xcp_e", "ueye_xls_e", "evk3_hd"),
    ("dvxplorer",),
    ("dvxplorer_micro", "dvxplorer_micro_firmware9"),
    ("silkyevcam_vga", "evk3_vga"),
    ("genx320",),
    ("evk4_v4l2", "genx320_v4l2"),
    ("triton2",),
)
"""Keys of the cameras of each table."""

HEADINGS = {
    "silkyevcam_hd": "Siblings of the EVK4",
    "dvxplorer_micro": "DVXplorer Micro",
    "silkyevcam_vga": "Gen 3.1",
    "evk4_v4l2": "Sensors on V4L2",
}
"""Heading of a table of several cameras, by its first one."""

NOT_RUN = (
    ("DV, jAER", "DAVIS346, DVXplorer", "programs with a graphical surface"),
    ("libcaer_driver, metavision_driver (ROS)", "all on USB", "need ROS; they use libcaer and OpenEB"),
    ("Metavision SDK", "EVK4, EVK3 HD", "closed; OpenEB is its open part"),
    ("plug-ins of CenturyArks and IDS", "their cameras", "closed"),
    ("Arena SDK", "Triton2 EVS", "closed"),
)

_HEAD = """# Cameras and clients

The tests that passed for each camera and each unmodified client, in the run of {dates}. The clients run on a Linux
kernel's USB in a guest that QEMU emulates ([how to attach a camera](cameras.md)), those of GigE Vision on the host's
own network. No real camera was at hand: one may behave otherwise where [Cameras](cameras.md) says *inferred*, *assumed*
or *not public*, and it sends from the start, without a start delay. This page is written from the outcomes:

```sh
EVSTIM_MATRIX=docs/device_matrix.json python -m pytest -m guest --timeout 900
python docs/device_matrix.py
```

| cell | meaning |
|---|---|
| exact | every value that the client returned was compared with what left the camera, and is equal |
| shown | a test of it passed |
| **fails** | a test of it failed in the run; the reason stands below the table |
| not run | a test exists, and was skipped in the run |
| not in the client | the client cannot do this with any such camera |
| empty, or no row | no test exists |
| –, or no row | the camera does not have it |

A number is that of the test below the table; a letter is that of a note. Settings are changed, and cameras unplugged,
while they stream; *opened often* is closed amid the streams again and again, [so often](#counts)."""

_COUNTS = """## Counts

The last run of each test that records its length, and the client's time in the guest; of 100 openings by another camera
than the Micro, the time of the whole test, with the start of QEMU. It emulates the processor (no KVM), so each
opening takes seconds, and more beside other work: in the runs of 2026-11-27 and 28 the two cores had a load of 1 to 10.

| camera | client | amount | time | date | machine |
|---|---|---|---|---|---|"""


def cell_word(column: str, outcomes: Iterable[str]) -> str:
    """Return the word of a cell from the outcomes of its tests: it is green only if none failed and one passed."""
    found = set(outcomes)
    if "failed" in found:
        return "**fails**"
    return COLUMNS[column].shown if "passed" in found else "not run"


class _Table:
    """A table of one camera or several, with its tests numbered and its notes lettered in the order of their cells.

    A column is a client, of several cameras with the same clients a camera: so no table has more than six columns.
    """

    def __init__(self, keys: Sequence[str], rows: Sequence[Row]) -> None:
        self._cameras = {key: CAMERAS[key] for key in keys}
        self._heading = HEADINGS.get(keys[0]) or CAMERAS[keys[0]].name
        self._rows = [row for row in rows if row["camera"] in keys]
        self._tests: dict[str, list[Row]] = {}
        self._notes: list[str] = []

    def text(self) -> str:
        headings, rows = self._by_camera() if len(self._cameras) > 2 else self._by_client()
        lines = [f"## {self._heading}", "", _line(headings), "|---" * len(headings) + "|"]
        lines += [_line(row) for row in rows if set(row[1:]) - {"", "–"}]
        return "\n".join([*lines, "", *self._list_of_tests(), *self._list_of_notes()])

    def _by_client(self) -> tuple[list[str], list[list[str]]]:
        """Return the headings, clients of each camera, and a row for each capability."""
        pairs = [(key, client) for key, camera in self._cameras.items() for client in camera.clients]
        prefixes = {key: f"{camera.name}: " if len(self._cameras) > 1 else "" for key, camera in self._cameras.items()}
        headings = ["", *(f"{prefixes[key]}{CLIENTS[client]}" for key, client in pairs)]
        return headings, [
            [COLUMNS[what].heading, *(self._cell(key, client, what) for key, client in pairs)] for what in COLUMNS
        ]

    def _by_camera(self) -> tuple[list[str], list[list[str]]]:
        """Return the headings, cameras, and a row for each client and capability."""
        clients = next(iter(self._cameras.values())).clients
        headings = ["", *(camera.name for camera in self._cameras.values())]
        return headings, [
            [
                f"{CLIENTS[client]}: {COLUMNS[what].heading}",
                *(self._cell(key, client, what) for key in self._cameras),
            ]
            for client in clients
            for what in COLUMNS
        ]

    def _cell(self, key: str, client: str, column: str) -> str:
        camera = self._cameras[key]
        rows = [row for row in self._rows if row["camera"] == key and row["client"] == client and column in row["what"]]
        if rows:
            numbers = dict.fromkeys(self._number(row) for row in rows)
            marks = [str(number) for number in numbers] + self._letters(camera.remarks.get((client, column)))
            return f"{cell_word(column, (row['outcome'] for row in rows))} ({', '.join(marks)})"
        if column in camera.lacks:
            return "–"
        if reason := camera.limits.get((client, column)):
            return f"not in the client ({self._letters(reason)[0]})"
        return ""

    def _number(self, row: Row) -> int:
        """Return the number of a test; its parameters share one."""
        name = row["test"].partition("[")[0]
        rows = self._tests.setdefault(name, [])
        if all(row["test"] != known["test"] for known in rows):
            rows.append(row)
        return list(self._tests).index(name) + 1

    def _letters(self, note: str | None) -> list[str]:
        if note is None:
            return []
        if note not in self._notes:
            self._notes.append(note)
        return [chr(ord("a") + self._notes.index(note))]

    def _list_of_tests(self) -> list[str]:
        return [f"{k}. `{name}`{_of_parameters(rows)}" for k, (name, rows) in enumerate(self._tests.items(), 1)]

    def _list_of_notes(self) -> list[str]:
        notes = [f"- {chr(ord('a') + k)}: {note}" for k, note in enumerate(self._notes)]
        return ["", "Notes:", "", *notes] if notes else []


def _of_parameters(rows: Sequence[Row]) -> str:
    """Return the parameters of a test, and the reason of each that did not pass."""
    named = [row["test"].partition("[")[2].removesuffix("]") for row in rows]
    passed = [name for name, row in zip(named, rows, strict=True) if row["outcome"] == "passed" and name]
    text = f" [{', '.join(passed)}]" if passed else ""
    for name, row in zip(named, rows, strict=True):
        if row["outcome"] != "passed":
            state = {"failed": "failed", "skipped": "not run"}[row["outcome"]]
            text += f"; {f'[{name}] ' if name else ''}{state}: {row['reason'].replace('|', '/')}"
    return text


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def counts(rows: Sequence[Row]) -> str:
    """Return the table of the rows that have an amount."""
    lines = [
        _line((CAMERAS[row["camera"]].name, str(CLIENTS[row["client"]]), row["amount"], f"{row['seconds']} s",
               row["date"], row["machine"]))
        for row in rows
        if "amount" in row
    ]  # fmt: skip
    return "\n".join([_COUNTS, *lines])


def page(rows: Sequence[Row]) -> str:
    """Return the page of these outcomes."""
    dates = sorted({row["date"] for row in rows})
    span = " to ".join(dict.fromkeys([*dates[:1], *dates[-1:]]))
    tables = [_Table(keys, rows).text() for keys in TABLES]
    not_run = ["## Not run", "", _line(("client", "cameras", "reason")), "|---|---|---|", *map(_line, NOT_RUN)]
    return "\n\n".join([_HEAD.replace("{dates}", span), *tables, counts(rows), "\n".join(not_run)]) + "\n"


def load() -> list[Row]:
    """Return the outcomes in the repository."""
    rows: list[Row] = json.loads(OUTCOMES.read_text(encoding="utf-8"))
    return rows


if __name__ == "__main__":
    PAGE.write_text(page(load()), encoding="utf-8")
