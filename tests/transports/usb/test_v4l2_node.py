"""A camera on USB as a sensor on V4L2: the kernel module's part is played through a socket that keeps messages whole.

The module itself, with its clients, is in tests/guest/test_v4l2.py.
"""

import errno
import os
import socket
import struct

import numpy as np
import pytest

from evstim.testing.link_contract import event_stream
from firmware_protocol.evt.evt2 import Evt2Decoder
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.genx320.device import Genx320, Genx320Settings
from firmware_protocol.genx320.registers import V4L2_SENSOR as GENX320
from firmware_protocol.imx636.evk4 import BOARDS, Evk4, Evk4Settings
from firmware_protocol.imx636.registers import V4L2_SENSOR as IMX636
from transports.usb.host import PeerGone, UnsuitableDevice
from transports.usb.loopback import DirectHost
from transports.usb.treuzell_host import TreuzellHost
from transports.usb.v4l2_node import Node, NodeError, opened

BIAS = 0x983902
MAKE = {
    "genx320": lambda: Genx320(Genx320Settings(start_delay_us=0)),
    "imx636": lambda: Evk4(Evk4Settings(start_delay_us=0)),
}
DECODERS = {"evt2": lambda: Evt2Decoder("evt2"), "evt21": lambda: Evt2Decoder("evt21"), "evt3": Evt3Decoder}


class Kernel:
    """The other end: requests to the node, its answers and words."""

    def __init__(self, name):
        self.camera, self.sensor = MAKE[name](), {"genx320": GENX320, "imx636": IMX636}[name]
        self.words = []
        self.end, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.end.settimeout(10)
        other.setblocking(False)
        self.node = Node(TreuzellHost(DirectHost(self.camera)), other.detach(), 4096)
        self.description = self.end.recv(65536)

    def request(self, kind, key=0, value=0, values=()):
        """Return the errno of the answer; words that come before it are kept."""
        self.end.send(struct.pack("=IIq74I", kind, key, value, *values, *[0] * (74 - len(values))))
        self.turn()
        while (message := self.end.recv(65536))[:4] == struct.pack("=I", 2):
            self.words.append(message[4:])
        return -struct.unpack("=Ii", message)[1]

    def turn(self, turns=1):
        left = iter(range(turns))
        self.node.run(lambda counts: next(left, None) is not None)


@pytest.fixture(params=sorted(MAKE))
def kernel(request):
    kernel = Kernel(request.param)
    yield kernel
    kernel.node.close()
    kernel.end.close()


def test_words_of_each_format_reach_the_buffers(kernel):
    for place, one in enumerate(kernel.sensor.formats):
        if one.form not in DECODERS:
            continue
        assert kernel.request(2, place) == 0
        assert kernel.request(1, value=1) == 0
        kernel.camera.advance(kernel.camera.now_us + 1000)
        sent = event_stream(3000, kernel.camera.now_us, kernel.sensor.size)
        kernel.camera.offer(sent)
        kernel.camera.advance(int(sent["t"][-1]) + 1)
        kernel.words.clear()
        kernel.turn(4)
        assert kernel.request(1, value=0) == 0
        assert max(map(len, kernel.words)) <= 4096
        seen, _ = DECODERS[one.form]().decode(b"".join(kernel.words))
        seen["t"] += np.uint64(kernel.camera.epoch_us)
        assert np.array_equal(seen, sent)
        assert not kernel.camera.streaming
    assert kernel.node.counts.octets > 0


def test_a_setting_reaches_the_sensor_before_its_answer(kernel):
    initial = kernel.camera.biases["diff_on"]
    assert kernel.request(3, BIAS, initial + 5) == 0
    assert kernel.camera.biases["diff_on"] == initial + 5
    assert kernel.request(3, BIAS, 300) == errno.ERANGE
    assert kernel.request(3, 0x123) == errno.EINVAL
    assert kernel.node.counts.settings == 1


def test_a_lost_camera_ends_it_and_the_client_gets_an_error(kernel, monkeypatch):
    def lost(*_):
        raise PeerGone("the camera went away")

    monkeypatch.setattr(DirectHost, "bulk_out", lost)
    assert kernel.request(3, BIAS, 30) == errno.EIO
    assert kernel.node.counts.gone


def test_a_lost_camera_is_noticed_without_a_stream(kernel, monkeypatch):
    kernel.turn(3)
    assert not kernel.node.counts.gone

    def lost(*_):
        raise PeerGone("the camera went away")

    monkeypatch.setattr(DirectHost, "bulk_out", lost)
    kernel.turn(3)
    assert kernel.node.counts.gone


def test_a_sensor_without_a_driver_on_v4l2_is_refused():
    camera = Evk4(Evk4Settings(board=BOARDS["evk3_hd"]))
    with pytest.raises(UnsuitableDevice, match="no driver on V4L2 is known for its sensor"):
        Node(TreuzellHost(DirectHost(camera)), -1, 4096)


def test_a_module_that_is_not_loaded_or_not_ours_is_named(tmp_path):
    with pytest.raises(NodeError, match="build and load the module evstim_v4l2"):
        opened(str(tmp_path / "none"))
    reading, writing = os.pipe()
    os.close(reading)
    with pytest.raises(NodeError, match="the module refuses the sensor"):
        Node(TreuzellHost(DirectHost(MAKE["genx320"]())), writing, 4096)
    os.close(writing)
