"""Serial ports that never wait, and errors that say what to do."""

import os
import socket
import stat
import subprocess
import sys

import pytest
import serial

from tests.waiting import until
from transports.serial_line.kind import SerialLink
from transports.serial_line.port import DescriptorPort, PtyPort, ThreadedPort, open_port, remove_abandoned

PATIENCE_S = 120.0


@pytest.fixture
def pty():
    port = PtyPort()
    yield port
    port.close()


def test_a_pty_knows_whether_it_is_read(pty):
    assert not pty.has_reader
    assert pty.read() == b""
    with serial.Serial(pty.address):
        assert pty.has_reader
    assert not pty.has_reader


def test_every_byte_goes_both_ways_unchanged(pty):
    every = bytes(range(256))
    with serial.Serial(pty.address, timeout=PATIENCE_S) as reader:
        assert pty.has_reader
        assert pty.write(every) == 256
        assert reader.read(256) == every
        reader.write(every)
        assert until(pty.read) == every


def test_a_full_pty_takes_what_it_has_room_for(pty):
    with serial.Serial(pty.address, timeout=PATIENCE_S) as reader:
        taken = 0
        while n := pty.write(bytes(1000)):
            taken += n
        assert 4096 <= taken <= 1 << 17
        assert until(lambda: pty.unsent)  # the kernel moves bytes in its own time
        assert len(reader.read(taken)) == taken
        assert pty.unsent == 0
        assert pty.write(b"more") == 4


def test_a_new_reader_does_not_get_what_the_last_one_left(pty):
    with serial.Serial(pty.address):
        assert pty.has_reader
        while pty.write(b"stale" * 100):
            pass
    assert not pty.has_reader
    reader = os.open(pty.address, os.O_RDWR | os.O_NOCTTY)  # pyserial would throw away what is old by itself
    assert pty.has_reader
    pty.write(b"fresh")
    assert os.read(reader, 100) == b"fresh"
    os.close(reader)


def test_a_reader_sees_the_pty_hang_up():
    pty = PtyPort()
    reader = open_port(SerialLink(port=pty.address))
    assert pty.has_reader
    pty.close()
    with pytest.raises(OSError, match=r"hung up|Input/output"):
        until(reader.read)
    reader.close()


def test_a_link_leads_to_the_pty_and_goes_with_it(tmp_path):
    link = tmp_path / "camera"
    port = open_port(SerialLink(symlink=str(link)))
    assert port.address == str(link)
    assert stat.S_ISCHR(os.stat(link).st_mode)
    port.close()
    assert not link.is_symlink()


def test_the_link_of_a_running_port_is_neither_replaced_nor_removed(tmp_path):
    link = tmp_path / "camera"
    port = open_port(SerialLink(symlink=str(link)))
    target = os.readlink(link)
    with pytest.raises(OSError, match="a running link has it"):
        open_port(SerialLink(symlink=str(link)))
    remove_abandoned(link)
    assert os.readlink(link) == target
    port.close()
    again = open_port(SerialLink(symlink=str(link)))
    again.close()
    assert not link.is_symlink()


KILLED = """
import os, sys
from transports.serial_line.port import open_port
from transports.serial_line.kind import SerialLink
port = open_port(SerialLink(symlink=sys.argv[1]))
os.kill(os.getpid(), 9)
"""


@pytest.mark.system
def test_the_link_of_a_killed_process_is_replaced_by_the_next_start_or_removed(tmp_path):
    link = tmp_path / "camera"
    for _ in range(2):
        subprocess.run([sys.executable, "-c", KILLED, link], cwd=os.getcwd(), check=False, timeout=60)
        assert link.is_symlink()
    remove_abandoned(link)
    assert not link.is_symlink()


@pytest.mark.parametrize("target", ["/nowhere", "/dev/pts/0", "/dev/pts/99999", ".", "a/./b"])
def test_a_user_s_own_link_is_neither_replaced_nor_removed(tmp_path, target):
    link = tmp_path / "camera"
    link.symlink_to(target)
    with pytest.raises(OSError, match="it exists, and no link of this kind made it"):
        open_port(SerialLink(symlink=str(link)))
    remove_abandoned(link)
    assert os.readlink(link) == target
    link.unlink()
    port = open_port(SerialLink(symlink=str(link)))
    link.unlink()
    link.symlink_to(target)
    port.close()
    assert os.readlink(link) == target


def test_what_is_not_a_link_to_a_pty_stays(tmp_path):
    remove_abandoned(tmp_path / "nothing")
    (tmp_path / "file").write_text("precious")
    remove_abandoned(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "precious"


@pytest.mark.parametrize("name", ["taken", "missing/camera"])
def test_a_link_replaces_nothing_that_is_no_link(tmp_path, name):
    (tmp_path / "taken").write_text("precious")
    with pytest.raises(OSError, match="give a path that is free"):
        open_port(SerialLink(symlink=str(tmp_path / name)))
    assert (tmp_path / "taken").read_text() == "precious"


def test_a_port_that_is_not_there_says_so():
    with pytest.raises(OSError, match="is it plugged in"):
        open_port(SerialLink(port="/dev/ttyNOWHERE0"))


def test_a_port_without_permission_names_the_group(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise serial.SerialException(13, "could not open port /dev/ttyS0: [Errno 13] Permission denied: '/dev/ttyS0'")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(OSError, match="usermod -aG dialout"):
        open_port(SerialLink(port="/dev/ttyS0"))


def test_a_busy_port_says_who_has_it(pty):
    with serial.Serial(pty.address, exclusive=True), pytest.raises(OSError, match="another program has it; `fuser"):
        open_port(SerialLink(port=pty.address))


def test_settings_that_a_port_lacks_are_told(pty):
    with pytest.raises(OSError, match="cannot do these settings"):
        open_port(SerialLink(port=pty.address, rs485=True))


def test_what_a_pty_ignores_it_accepts(pty):
    parameters = SerialLink(port=pty.address, parity="even", stop_bits=2, break_ms=1, flow="rts_cts")
    open_port(parameters).close()
    assert not pty.has_reader


def test_an_unknown_url_is_told():
    with pytest.raises(OSError, match="cannot open nonsense://x"):
        open_port(SerialLink(port="nonsense://x"))


@pytest.mark.socket
def test_a_socket_is_a_port_too():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = open_port(SerialLink(port=f"socket://127.0.0.1:{server.getsockname()[1]}"))
        peer, _ = server.accept()
        assert isinstance(port, DescriptorPort)
        assert port.write(b"out") == 3
        assert peer.recv(10) == b"out"
        peer.sendall(b"in")
        assert until(port.read) == b"in"
        peer.close()
        with pytest.raises(OSError, match=r"hung up|reset"):
            until(port.read)
        port.close()


@pytest.mark.socket
def test_nobody_at_the_socket_is_told():
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    with pytest.raises(OSError, match="start what listens there first"):
        open_port(SerialLink(port=f"socket://127.0.0.1:{free}"))


def test_a_port_that_blocks_has_a_thread_of_its_own():
    port = open_port(SerialLink(port="loop://", baud=1_000_000))
    assert isinstance(port, ThreadedPort)
    assert port.write(b"round and back") == 14
    got = b""
    while got != b"round and back":
        got += until(port.read)
    assert port.unsent == 0
    while port.write(bytes(1000)):
        pass
    assert port.unsent > 0
    port.close()


class Broken:
    """A port whose write fails."""

    port = "broken://"

    def write(self, data):
        raise serial.SerialException("connection failed")

    def close(self):
        pass


def test_a_failure_of_the_thread_is_raised_by_the_next_write():
    port = ThreadedPort(Broken())
    port.write(b"x")

    def fails():
        try:
            port.write(b"y")
        except OSError as error:
            return str(error)
        return None

    assert until(fails) == "connection failed"
    port.close()


@pytest.mark.parametrize(("field", "value"), [("port", ""), ("baud", 10), ("stop_bits", 3), ("break_ms", -1)])
def test_parameters_refuse_nonsense_by_the_key(field, value):
    with pytest.raises(ValueError, match=field):
        SerialLink(**{field: value})


def test_a_link_needs_a_pty():
    with pytest.raises(ValueError, match="symlink is for"):
        SerialLink(port="/dev/ttyS0", symlink="/tmp/x")


@pytest.mark.parametrize(
    ("changes", "bits"), [({}, 10), ({"parity": "even"}, 11), ({"stop_bits": 2}, 11), ({"data_bits": 7}, 9)]
)
def test_the_character_has_its_bits(changes, bits):
    assert SerialLink(**changes).bits == bits
