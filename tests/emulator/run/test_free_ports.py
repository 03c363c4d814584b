"""Ports that others cannot have taken, and ports that belong to somebody else."""

from emulator.rig.loading import parse_rig
from emulator.run.machine import on_a_free_pose_port, on_free_ports, pose_port

RIG = """
[scene]
kind = "checkerboard"
[[links]]
kind = "usbip"
[[links]]
kind = "tcp"
[[links]]
kind = "udp"
port = 8991
[[links]]
kind = "serial"
symlink = "/tmp/line"
"""


def test_what_listens_gets_a_free_port_and_where_datagrams_go_stays(tmp_path):
    usbip, tcp, udp, serial = on_free_ports(parse_rig(RIG, "a.toml", "a"), tmp_path).links
    assert (usbip.port, tcp.port, udp.port) == (0, 0, 8991)
    assert serial.symlink == str(tmp_path / "serial.tty")


LIVE = """
[scene]
kind = "terrain"
[scene.camera]
kind = "live"
port = 10364
"""


def test_poses_from_outside_get_a_free_port():
    rig = parse_rig(LIVE, "a.toml", "a")
    ports = {pose_port(on_a_free_pose_port(rig)) for _ in range(3)}
    assert pose_port(rig) == 10364
    assert None not in ports
    assert not ports & {0, 10364}


def test_a_rig_with_its_own_path_stays_as_it_is():
    rig = parse_rig(RIG, "a.toml", "a")
    assert pose_port(rig) is None
    assert on_a_free_pose_port(rig) is rig
