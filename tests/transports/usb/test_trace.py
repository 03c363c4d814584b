"""The trace of a USB cable: as text, and as tshark reads it."""

import shutil
import subprocess
from collections import Counter
from contextlib import closing

import pytest

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.usb.usbip import Submit, Unlink
from tests.transports.usb.raw_host import attached, read_urb, submit
from transports.faults.faulty_device import FaultyDevice
from transports.faults.script import FaultPlan
from transports.faults.usb import ControlStall
from transports.usb.davis_host import DavisHost
from transports.usb.host import StallError, StreamSettings
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.connection import Found
from transports.usb.usbip.trace import UrbTrace

BEGUN_NS = 1_700_000_000_000_000_000
FIELDS = [
    "urb_type", "transfer_type", "endpoint_address", "urb_status", "urb_len", "data_len", "device_address", "bus_id",
    "setup.bRequest", "setup.wValue",
]  # fmt: skip


@pytest.fixture(autouse=True)
def unhurried(monkeypatch):
    """A writer that has two minutes to finish its files, not the seconds of a run."""
    monkeypatch.setattr("transports.usb.usbip.trace._CLOSE_TIMEOUT_S", 120.0)


class Ticks:
    """Time that goes on by a microsecond at each look."""

    def __init__(self):
        self.now_ns = BEGUN_NS

    def __call__(self):
        self.now_ns += 1000
        return self.now_ns


def tshark(path):
    """The URBs of a pcap file as tshark sees them, a dict of texts each."""
    if shutil.which("tshark") is None:
        pytest.skip("tshark is not installed")
    names = ["frame.time_epoch", "usb.urb_id", *(f"usb.{name}" for name in FIELDS)]
    command = ["tshark", "-r", path, "-T", "fields", *(part for name in names for part in ("-e", name))]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    return [dict(zip(names, line.split("\t"), strict=True)) for line in done.stdout.splitlines()]


@pytest.fixture
def traced(bench, tmp_path):
    """A driver's session with a camera, and the two files that tell of it."""
    camera = Davis346(Davis346Settings(start_delay_us=0))
    faulty = FaultyDevice(camera, FaultPlan("usb"))
    trace = UrbTrace(tmp_path / "usb", faulty, Ticks())
    bench.start({"2-3": faulty}, observer=trace)
    host = UsbipHost.attach(port=bench.server.port, busid="2-3", timeout_s=120)
    driver = DavisHost(host)
    driver.start(StreamSettings(transfer_bytes=8192, transfers=3))
    bench.call(faulty.inject, ControlStall(count=1))
    with pytest.raises(StallError):
        driver.read_register(6, 3)
    driver.write_register(1, 41, 7)
    driver.close()
    bench.run(bench.server.close())
    trace.close()
    assert trace.trouble == ""
    return (tmp_path / "usb.txt").read_text().splitlines(), tmp_path / "usb.pcap"


@pytest.mark.socket
def test_the_text_names_requests_and_registers(traced):
    lines, _ = traced
    asked = [line.split(maxsplit=5) for line in lines if " S " in line]
    told = [parts[5] for parts in asked]
    for what in (
        "SET_CONFIGURATION 1", "GET_DESCRIPTOR string 3", "read system.LOGIC_VERSION (6.0)", "log level 4",
        "flush the data path", "CLEAR_FEATURE halt of endpoint 0x82", "write dvs.ROI_START_COLUMN (1.41) = 7",
        "write multiplexer.TIMESTAMP_RESET (0.2) = 1, multiplexer.TIMESTAMP_RESET (0.2) = 0",
        "endpoint 0x82, 8192 bytes",
    ):  # fmt: skip
        assert what in told
    answers = [line.split(maxsplit=5)[5] for line in lines if " C " in line]
    assert "ok, 4 bytes: system.LOGIC_VERSION (6.0) = 18" in answers
    assert answers.count("STALL") == 1
    taken_back = {line.split()[2] for line in lines if line.endswith("taken back")}
    assert taken_back == {line.split()[2] for line in lines if line.endswith("unlink        of a URB pending")}
    assert taken_back
    times = [float(line.split()[0]) for line in lines if not line.startswith("#")]
    assert times == sorted(times)


@pytest.mark.socket
def test_tshark_reads_every_urb(traced):
    lines, pcap = traced
    urbs = tshark(pcap)
    assert len(urbs) == sum(not line.startswith("#") and " U " not in line for line in lines)
    types = Counter(urb["usb.urb_type"] for urb in urbs)
    assert types["'S'"] == types["'C'"] == len(urbs) / 2
    kinds = Counter((urb["usb.transfer_type"], urb["usb.endpoint_address"]) for urb in urbs)
    assert set(kinds) == {("0x02", "0x00"), ("0x02", "0x80"), ("0x03", "0x82")}
    assert {(urb["usb.bus_id"], urb["usb.device_address"]) for urb in urbs} == {("2", "4")}
    assert {urb["usb.urb_status"] for urb in urbs if urb["usb.urb_type"] == "'S'"} == {"-115"}
    assert Counter(urb["usb.urb_status"] for urb in urbs if urb["usb.urb_type"] == "'C'")["-32"] == 1
    times = [float(urb["frame.time_epoch"]) for urb in urbs]
    assert times == sorted(times)
    assert BEGUN_NS / 1e9 < times[0] < BEGUN_NS / 1e9 + 1


@pytest.mark.socket
def test_tshark_reads_setup_packets_and_data(traced):
    _, pcap = traced
    urbs = tshark(pcap)
    write = [u for u in urbs if u["usb.setup.bRequest"] == "191" and u["usb.setup.wValue"] == "0x0001"]
    assert {(u["usb.urb_len"], u["usb.data_len"]) for u in write if u["usb.endpoint_address"] == "0x00"} == {("4", "4")}
    bulk = [u for u in urbs if u["usb.endpoint_address"] == "0x82"]
    ids = [u["usb.urb_id"] for u in bulk if u["usb.urb_type"] == "'S'"]
    assert sorted(ids) == sorted(u["usb.urb_id"] for u in bulk if u["usb.urb_type"] == "'C'")
    assert {u["usb.data_len"] for u in bulk if u["usb.urb_type"] == "'S'"} == {"0"}
    full = [u for u in bulk if u["usb.urb_status"] == "0"]
    assert full
    assert all(u["usb.urb_len"] == u["usb.data_len"] != "0" for u in full)


def urb(number, data=b""):
    return Submit(number, 1 << 16 | 2, True, 2, 512, data=data)


@pytest.fixture
def trace(tmp_path, at_end):
    """Makes traces, and closes them."""
    return lambda **more: at_end.enter_context(closing(UrbTrace(tmp_path / "usb", Davis346(), Ticks(), **more)))


def test_unlinks_tell_how_they_found_their_urbs(trace, tmp_path):
    one = trace()
    for found in Found:
        one.unlinked(Unlink(9, 0x10002, 7), found)
    one.close()
    lines = [line.split(maxsplit=3) for line in (tmp_path / "usb.txt").read_text().splitlines() if line[0] != "#"]
    assert [line[1:] for line in lines] == [["U", "7", f"unlink        of a URB {found.value}"] for found in Found]
    assert tshark(tmp_path / "usb.pcap") == []


@pytest.mark.socket
def test_unlinks_are_in_the_trace_before_the_ends_of_their_urbs(bench, device, tmp_path):
    trace = UrbTrace(tmp_path / "usb", device, Ticks())
    bench.start({"1-1": device}, observer=trace)
    sock = attached(bench)
    sock.sendall(submit(1) + b"".join(bytes(Unlink(9, 0x10002, victim)) for victim in (1, 2, 1)) + submit(2))
    assert [read_urb(sock) for _ in range(3)] == [(4, 9, -104), (4, 9, 0), (4, 9, -104)]
    sock.close()
    bench.run(bench.server.close())
    trace.close()
    lines = [line.split(maxsplit=5) for line in (tmp_path / "usb.txt").read_text().splitlines() if line[0] != "#"]
    assert [(line[1], line[2], line[-1].removeprefix("a URB ")) for line in lines] == [
        ("S", "1", "endpoint 0x82, 100 bytes"), ("U", "1", "pending"), ("C", "1", "taken back"),
        ("U", "2", "still to come"), ("U", "1", "over, or never seen"),
        ("S", "2", "endpoint 0x82, 100 bytes"), ("C", "2", "taken back"),
    ]  # fmt: skip


def test_what_does_not_fit_the_queue_is_counted_and_told(trace, tmp_path, monkeypatch):
    monkeypatch.setattr("transports.usb.usbip.trace._PERIOD_S", 600.0)  # nothing is written before the end
    one = trace(capacity_bytes=600)
    for number in range(1, 4):
        one.completed(urb(number), 0, 512, bytes(512))
    one.close()
    assert one.missing == 2
    assert one.trouble == "USB trace: 2 records are missing, the disk was too slow"
    assert "# 2 records are missing here" in (tmp_path / "usb.txt").read_text()
    assert len(tshark(tmp_path / "usb.pcap")) == 1


@pytest.mark.parametrize("name", ["usb.pcap", "usb.txt"])
def test_a_full_disk_ends_one_file_with_a_message_and_not_the_run(trace, tmp_path, name):
    (tmp_path / name).symlink_to("/dev/full")
    one = trace()
    one.submitted(urb(1))
    one.completed(urb(1), 0, 2, b"ab")
    one.close()
    assert one.trouble == f"USB trace stopped: No space left on device ({tmp_path / name})"
    whole = tmp_path / ("usb.txt" if name == "usb.pcap" else "usb.pcap")
    assert whole.stat().st_size > 100


def test_a_link_that_is_started_again_leaves_the_first_trace(trace, tmp_path):
    for _ in range(3):
        trace().close()
    assert {path.name for path in tmp_path.iterdir()} == {
        f"usb{part}{suffix}" for part in ("", "-restart1", "-restart2") for suffix in (".txt", ".pcap")
    }


@pytest.mark.socket
def test_what_waits_when_a_host_goes_is_over_too(bench, tmp_path):
    trace = UrbTrace(tmp_path / "usb", Davis346(), Ticks())
    camera = Davis346()
    bench.start({"1-1": camera}, observer=trace)
    with UsbipHost.attach(port=bench.server.port, timeout_s=120) as host:
        host.configure()
        host.stream(2, 512, 2)
        DavisHost(host)
        bench.run(bench.server.close(linger_s=0))
    trace.close()
    text = (tmp_path / "usb.txt").read_text()
    assert text.count(" bulk IN       device gone") == text.count(" bulk IN       endpoint 0x82, 512 bytes") == 2
