"""The camera and the link of examples/, installed as packages and read by receivers that share no code with evstim."""

import json
import shutil
import socket
import struct
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
import usbip

from tests.free_ports import free_port
from tests.installed import environment, install

pytestmark = [pytest.mark.system, pytest.mark.socket]

EXAMPLES = Path(__file__).parents[2] / "examples"


@contextmanager
def running(folder, name, tmp_path, old, new):
    """Give the process of a run of an example's rig with one line changed, which records what its link delivers."""
    site = install(EXAMPLES / folder, tmp_path / "site")
    rig = tmp_path / "rig.toml"
    text = (EXAMPLES / folder / name).read_text()
    assert old in text
    rig.write_text(text.replace(old, new).replace("seconds = 5.0", "seconds = 1.0"))
    command = [sys.executable, "-c", "from emulator.cli import main; main()", "run", str(rig), "--json"]
    files = ["--record", str(tmp_path / "delivered.npz"), "--ready-file", str(tmp_path / "ready")]
    with subprocess.Popen([*command, *files], cwd=tmp_path, env=environment(site), stdout=subprocess.PIPE) as process:
        while not (tmp_path / "ready").exists() and process.poll() is None:
            time.sleep(0.05)
        assert process.poll() is None, "the run did not begin"
        yield process
        output, _ = process.communicate(timeout=120)
        assert json.loads(output.splitlines()[-1])["balanced"]


def delivered(tmp_path):
    with np.load(tmp_path / "delivered.npz") as record:
        return record["events"].tolist()


def test_a_usb_host_of_others_reads_the_camera(tmp_path):
    port, data = free_port(), b""
    with running("camera", "simple.toml", tmp_path, 'kind = "usbip"', f'kind = "usbip"\nport = {port}'):
        wire = usbip.transport.USBIP("127.0.0.1", port)
        with usbip.open(0x1209, 0x0001, transport=wire) as handle:
            assert handle.control(0x80, 6, 0x0302, 0x0409, 255)[2:].decode("utf-16-le") == "Simple camera"
            with pytest.raises(usbip.Stall):
                handle.control(0x40, 77, 1, 0, b"")
            handle.control(0x40, 1, 1, 0, b"")
            with suppress(usbip.USBError, OSError):  # the run has ended
                while True:
                    data += handle.bulk_in(0x81, 4096)
    read = [(t, x, y & 0x7FFF, bool(y >> 15)) for t, x, y in struct.iter_unpack("<IHH", data)]
    assert len(read) > 1000
    assert read == delivered(tmp_path)


def test_a_socket_reads_the_lines_of_the_link(tmp_path):
    lines = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)  # the sender does not wait for a slow reader
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.5)
        port = receiver.getsockname()[1]
        with running("link", "text.toml", tmp_path, "port = 9000", f"port = {port}") as process:
            while True:
                try:
                    lines += receiver.recv(65_536).decode().splitlines()
                except TimeoutError:
                    if process.poll() is not None:
                        break
    read = [(int(t), int(x), int(y), on == "1") for t, x, y, on in map(str.split, lines)]
    assert len(read) > 100
    assert read == delivered(tmp_path)


@pytest.mark.parametrize("folder", ["camera", "link"])
def test_pip_installs_it(folder, tmp_path):
    """The wheel has the module and the entry point, where the build back end is here."""
    pytest.importorskip("hatchling")
    project = shutil.copytree(EXAMPLES / folder, tmp_path / folder)
    from hatchling.builders.wheel import WheelBuilder

    assert len(list(WheelBuilder(str(project)).build(directory=str(tmp_path), versions=["standard"]))) == 1
