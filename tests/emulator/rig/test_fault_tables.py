"""Faults in a rig and by hand: which link can have which, and a run that is told of one while it goes."""

import json
import os
import socket
import stat
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from emulator.cli.app import _main
from emulator.rig.loading import RigError, parse_rig
from emulator.run.assembly import build_scene, build_session, link_setups, schedule
from emulator.run.control import (
    ControlSocket,
    FaultInjection,
    NoAnswer,
    fault_injection,
    runtime_directory,
    send_request,
    sockets,
)
from emulator.run.outcome import RunStatus
from emulator.run.pacing import Lateness
from transports.faults.bus import DeadBus
from transports.faults.line import BitFlips
from transports.faults.script import FaultRecord
from transports.link.loop import InjectFault
from transports.link.pacing import MonotonicClock
from transports.link.report import LinkReport

SCENE = '[scene]\nkind = "checkerboard"\nsquare_px = 40.0\nspeed_px_s = 3.0\n'
SERIAL = '[[links]]\nkind = "serial"\nport = "pty"\n'
CAN = '[[links]]\nkind = "can"\n[links.instrument]\nregion = [0, 0, 64, 64]\n'
LOOPBACK = '[[links]]\nkind = "loopback"\n'


def rig(links, fault=""):
    return parse_rig(SCENE + links + (f"[[faults]]\n{fault}\n" if fault else ""), "bench.toml", "bench")


@pytest.fixture
def runtime(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


def test_a_fault_finds_the_only_link_that_can_have_it():
    (fault,) = rig(SERIAL + LOOPBACK, 'kind = "bit_flips"\nat_s = 2.0\nrate = 1e-4').faults
    assert fault == BitFlips(link="serial", at_s=2.0, rate=1e-4)
    (fault,) = rig(SERIAL + CAN, 'kind = "dead_bus"\nbus = "A"\nlink = "can"').faults
    assert fault == DeadBus(link="can")


@pytest.mark.parametrize(
    ("links", "fault", "told"),
    [
        (LOOPBACK, 'kind = "bit_flips"', "no link of this rig can have"),
        (SERIAL + CAN, 'kind = "bit_flips"\nlink = "can"', "link 'can' cannot have"),
        (SERIAL, 'kind = "bit_flips"\nlink = "sreial"', "did you mean 'serial'"),
        (SERIAL + SERIAL + 'name = "two"\n', 'kind = "bit_flips"', "serial, two can all have"),
        (SERIAL, 'kind = "bit_flop"', "did you mean 'bit_flips'"),
        (SERIAL, 'kind = "bit_flips"\nrate = 2', "rate must be above 0"),
        (SERIAL, 'kind = "bit_flips"\nbus = "A"', "'bus' is not known here"),
        (CAN.replace('"can"\n', '"can"\ninterface = "socketcan"\n'), 'kind = "error_frames"', "no link of this rig"),
    ],
)
def test_a_fault_that_cannot_be_says_why(links, fault, told):
    with pytest.raises(RigError, match=told) as refusal:
        rig(links, fault)
    assert "bench.toml, line" in str(refusal.value)


def test_each_link_gets_its_own_faults_and_the_log(tmp_path):
    bench = rig(SERIAL + CAN, 'kind = "stall"\n[[faults]]\nkind = "lost_frames"')
    log = tmp_path / "log.jsonl"
    plans = [setup.endpoint.wiring.faults for setup in link_setups(bench, fault_log=log)]
    assert [(plan.link, [fault.kind for fault in plan.scripted]) for plan in plans] == [
        ("serial", ["stall"]),
        ("can", ["lost_frames"]),
    ]
    assert all(plan.log == log for plan in plans)


def test_the_socket_is_for_its_owner_only_and_goes_with_the_run(runtime):
    with ControlSocket("bench") as control:
        assert control.path == runtime / "evstim" / f"bench-{os.getpid()}.sock"
        assert stat.S_IMODE(control.path.stat().st_mode) == 0o600
        assert stat.S_IMODE(control.path.parent.stat().st_mode) == 0o700
        assert sockets() == [control.path]
    assert sockets() == []
    with pytest.raises(NoAnswer):
        send_request(control.path, {"request": "faults"})


def test_a_directory_of_others_is_not_used(runtime):
    (runtime / "evstim").mkdir(mode=0o777)
    (runtime / "evstim").chmod(0o777)
    with pytest.raises(PermissionError, match="yours alone"):
        runtime_directory()


def test_foreign_bytes_at_the_socket_hurt_nobody(runtime):
    said = [b"", b"\n", b"[]\n", b"{\n", b"\xff\n", b'{"request": 7}\n', b"x" * 5000, b'{"request": "fau', b"{}\nmore"]
    with ControlSocket("bench") as control:
        clients = []
        for data in said:
            client = socket.socket(socket.AF_UNIX)
            client.connect(str(control.path))
            client.sendall(data)
            clients.append(client)
        for _ in range(3):
            control.poll(lambda message: {"heard": message})
        answers = {}
        for data, client in zip(said, clients, strict=True):
            client.setblocking(False)
            try:
                answers[data] = client.recv(1000)
            except BlockingIOError:
                answers[data] = None  # it may still finish its line
            client.close()
    assert json.loads(answers[b'{"request": 7}\n']) == {"heard": {"request": 7}}
    assert json.loads(answers[b"{}\nmore"]) == {"heard": {}}
    assert all("error" in json.loads(answers[data]) for data in said[1:5])
    assert [answers[data] for data in (b"", b"x" * 5000, b'{"request": "fau')] == [None] * 3


class Injector:
    def __init__(self):
        self.injected = []
        self.ended = []

    def order(self, link, order):
        if isinstance(order, InjectFault):
            self.injected.append(order.fault)
        else:
            self.ended.append((link, order.number))


def status(**links):
    return RunStatus(1.5, 1.6, 10, 100, Lateness(), links)


def test_the_control_lists_and_injects():
    session = Injector()
    control = FaultInjection(rig(SERIAL + LOOPBACK), session, None)
    now = status(serial=LinkReport("open", faults=(FaultRecord(1, "stall", 5, 6, 1, 0),)))
    told = control.answer({"request": "faults"}, now)
    assert "bit_flips" in told["links"]["serial"]["kinds"]
    assert told["links"]["serial"]["injected"][0]["ended_us"] == 6
    assert told["links"]["loopback"] == {"kinds": [], "injected": [], "state": ""}
    answer = control.answer({"request": "inject", "fault": {"kind": "bit_flips", "rate": 0.5}}, now)
    assert answer == {"link": "serial", "after": 1}
    assert session.injected == [BitFlips(link="serial", rate=0.5)]


def test_the_control_ends_a_fault_that_lasts():
    session = Injector()
    control = FaultInjection(rig(SERIAL), session, None)
    now = status(serial=LinkReport("open", faults=(FaultRecord(1, "stall", 5, 6), FaultRecord(2, "burst", 7))))
    assert control.answer({"request": "end", "link": "serial", "number": 2}, now) == {"link": "serial", "kind": "burst"}
    assert "is over" in control.answer({"request": "end", "link": "serial", "number": 1}, now)["error"]
    for link, number in (("serial", 3), ("serial", -1), ("usb", 1)):
        answer = control.answer({"request": "end", "link": link, "number": number}, now)
        assert "there is no fault" in answer["error"]
    assert session.ended == [("serial", 2)]


@pytest.mark.parametrize(
    ("message", "told"),
    [
        ({}, "known requests"),
        ({"request": "inject"}, "known requests"),
        ({"request": "inject", "fault": 7}, "expected a table"),
        ({"request": "inject", "fault": {"kind": "bit_flips", "rate": "x"}}, "rate"),
        ({"request": "inject", "fault": {"kind": "lost_frames"}}, "no link"),
    ],
)
def test_the_control_says_what_is_wrong_and_injects_nothing(message, told):
    session = Injector()
    assert told in FaultInjection(rig(SERIAL), session, None).answer(message, status())["error"]
    assert session.injected == []


def test_without_a_socket_the_run_goes_on_and_says_so(runtime):
    (runtime / "evstim").write_text("not a directory")
    with fault_injection(rig(SERIAL), Injector()) as control:
        assert "no control socket" in control.trouble
        control.serve(status())
    with fault_injection(rig(""), Injector()) as control:
        assert control.trouble == ""


def test_the_word_for_it_without_a_run(runtime, capsys):
    assert _main(["fault"]) == 3
    assert _main(["fault", "bit_flips", "--run", "elsewhere", "--json"]) == 3
    assert "no rig 'elsewhere'" in capsys.readouterr().out


@pytest.mark.system
def test_a_fault_injected_into_a_run_is_done_and_told(runtime, capsys):
    bench = rig(SERIAL)
    bench = replace(bench, run=replace(bench.run, seconds=3000.0, max_late_ms=0.0))  # until `session.stop`
    codes = []

    def inject():
        codes.append(_main(["fault", "stall", "--for-s", "0.2", "--json"]))
        codes.append(_main(["fault", "stall", "--set", "for_s=0.1", "--set", "x"]))
        codes.append(_main(["fault", "lost_frames"]))
        codes.append(_main(["fault"]))
        session.stop()

    with build_scene(bench) as scene:
        session = build_session(bench, scene, link_setups(bench), MonotonicClock())
        with fault_injection(bench, session) as control:
            client = threading.Thread(target=inject)
            begun = []

            def on_status(now):
                control.serve(now)
                if not begun:
                    begun.append(now)
                    client.start()

            result = session.run(schedule(bench), on_status)
            client.join()
    assert codes == [0, 2, 2, 0]
    where = {"rig": bench.name, "pid": os.getpid()}
    said = capsys.readouterr().out
    told = json.loads(said.splitlines()[0])
    assert {key: told[key] for key in where} == where
    assert told["link"] == "serial"
    assert told["fault"]["kind"] == "stall"
    lasted_us = told["fault"]["ended_us"] - told["fault"]["began_us"]
    assert 190_000 < lasted_us < 120_000_000  # its end is noticed by a process that may have to wait for its turn
    assert "fault 1, stall, " in said
    assert [record.kind for record in result.links["serial"].faults] == ["stall"]
    assert result.good


def answers(monkeypatch, *runs):
    """Let runs of these (rig, process, folder) be found by the commands."""
    links = {"usbip": {"kinds": [], "injected": []}}
    known = {
        Path(f"{pid}.sock"): {"rig": name, "pid": pid, "folder": folder, "links": links} for name, pid, folder in runs
    }
    sent = []

    def answer(path, message):
        sent.append((path, message["request"]))
        return known[path] if message["request"] == "faults" else {"links": ["usbip"]}

    monkeypatch.setattr("emulator.cli.fault.sockets", lambda: list(known))
    monkeypatch.setattr("emulator.cli.fault.send_request", answer)
    return sent


@pytest.mark.parametrize("verb", ["fault", "trigger"])
@pytest.mark.parametrize(
    ("runs", "options", "code", "text"),
    [
        ([("eros", 7, "here")], [], 0, "eros (process 7)"),
        ([("eros", 7, "/another")], [], 2, "eros (process 7) in /another was started in another folder"),
        ([("eros", 7, "/another")], ["--run", "eros"], 0, "eros (process 7)"),
        ([("eros", 7, "/another")], ["--run", "7"], 0, "eros (process 7)"),
        ([("eros", 7, "here"), ("stars", 8, "/another")], [], 2, "eros (process 7) in"),
        ([("eros", 7, "here"), ("eros", 8, "here")], ["--run", "eros"], 2, "eros (process 8) in"),
        ([("eros", 7, "here"), ("eros", 8, "here")], ["--run", "8"], 0, "eros (process 8)"),
    ],
)
def test_a_run_of_another_terminal_is_reached_by_name_alone(verb, runs, options, code, text, monkeypatch, capsys):
    runs = [(name, pid, os.getcwd() if folder == "here" else folder) for name, pid, folder in runs]
    sent = answers(monkeypatch, *runs)
    assert _main([verb, *options]) == code
    printed = capsys.readouterr()
    assert text in " ".join((printed.err if code else printed.out).split())
    assert {request for _, request in sent} == {"faults"} | ({"trigger"} if verb == "trigger" and not code else set())
