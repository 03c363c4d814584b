"""What docs/cameras.md tells a new user to type works as it stands there: its rig, its commands, its programs.

Only where the camera is differs: it is served on the host, and a program in the guest forwards port 3240, as the page
has ssh do. `sudo` is a shell function, for the guest's user is root.
"""

import ast
import re
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.guest.attachment import usb_bus
from tests.guest.environments import DRIVERS
from tests.guest.machine import HOST_ADDRESS
from tests.guest.running_rig import RunningRig
from tests.guest.turns import Turns, long_but, selected

PAGE = Path(__file__).parents[2] / "docs" / "cameras.md"
PARTS = {"dv2": ("dv-processing", 0, 2), "dv1": ("dv-processing", 1, 2), "nd": ("neuromorphic_drivers", 0)}
"""Heading of the page, and the blocks below it that make a driver's program."""
PORT = "3240"
TIMEOUT_S = 300.0
FORWARD = str(Path(__file__).parent / "clients" / "forward.py")

pytestmark = [pytest.mark.guest, pytest.mark.socket, pytest.mark.timeout(3600)]


def blocks(heading):
    """(language, text) of each block of code under a heading of the page."""
    _, _, section = PAGE.read_text().partition(f"# {heading}\n")
    shielded = re.sub(r"^```.*?^```", _shield, section, flags=re.M | re.S)
    own = re.split(r"^#+ .*\n", shielded, maxsplit=1, flags=re.M)[0]
    found = re.findall(r"^```(\w+)\n(.*?)^```", own, re.M | re.S)
    return [(language, text.replace("\0", "#")) for language, text in found]


def _shield(block):
    """A block of code whose comments do not look like headings."""
    return block[0].replace("#", "\0")


def shell(guest, commands):
    """Run lines of the page in the guest as they stand."""
    return guest.check(["sh", "-ec", 'sudo() { "$@"; }\n' + commands], TIMEOUT_S)


@contextmanager
def forwarded(guest, port):
    """Port 3240 of the guest is the host's `port`."""
    (guest.results / "forward.pid").unlink(missing_ok=True)
    pid = guest.path_in_guest("forward.pid")
    job = guest.start([sys.executable, FORWARD, PORT, HOST_ADDRESS, str(port), pid], TIMEOUT_S * 4)
    guest.check(["sh", "-c", f"until [ -s {pid} ]; do sleep 0.05; done"], TIMEOUT_S)
    try:
        yield
    finally:
        guest.check(["sh", "-c", f"kill $(cat {pid})"])
        job.wait()


@pytest.fixture(scope="module")
def ended(request, guest, driver_pythons, tmp_path_factory):
    """The programs of the page, each with the camera attached by the commands of the page, on its rig."""
    (_, text), _, (_, attach), (_, detach) = blocks("Attach it")
    text = re.sub(rf"^port = {PORT}$", "port = {port}", text, flags=re.M)
    attach = attach.replace("modprobe", f"modprobe -d {guest.kernel.tree}")
    rig = RunningRig(tmp_path_factory.mktemp("docs"), text=text)

    def run(driver):
        heading, *numbers = PARTS[driver.name]
        program = "\n".join(blocks(heading)[number][1] for number in numbers)
        with forwarded(guest, rig.port):
            shell(guest, attach)
            ended = guest.run([str(driver_pythons[driver.name]), "-u", "-c", program], TIMEOUT_S)
            assert "<Port in Use>" in shell(guest, detach)
            usb_bus(guest, cameras=0)
            return ended

    return Turns(rig, selected(request, "driver"), run)


@pytest.mark.long
@pytest.mark.parametrize("driver", long_but(DRIVERS[-1:], DRIVERS), ids=lambda driver: driver.name)
def test_the_program_of_the_page_sees_all_streams(ended, driver):
    finished = ended.result(driver)
    assert finished.ok, finished
    assert "ERROR" not in finished.stdout + finished.stderr, finished  # as libcaer logs a frame with gaps
    seen = ast.literal_eval(finished.stdout.splitlines()[-1])
    assert min(seen[stream] for stream in ("events", "frames", "imu", "triggers")) >= 5
