"""The contract of USB cables, over the USB/IP server, a port in memory, the bus behind pyusb, and the loopback."""

import pytest

from evstim.testing.fake_usb import FakeUsbBus
from evstim.testing.usb_contract import DAVIS240C, DVXPLORER, DVXPLORER_MICRO, Plugged, UsbContract
from tests.transports.usb.gadget_port import GadgetBench, PortHost
from transports.usb.loopback import DirectHost
from transports.usb.pyusb_host import PyusbHost
from transports.usb.usbip.client import UsbipHost


@pytest.mark.socket
class TestUsbip(UsbContract):
    @pytest.fixture(autouse=True)
    def server(self, bench):
        self.bench = bench

    def plug(self, device, timeout_s):
        self.bench.run(self.bench.server.close(linger_s=120))
        self.bench.start({"1-1": device})

        def call(function, *args):
            self.bench.call(function, *args)
            self.bench.call(self.bench.server.pump)

        return Plugged(UsbipHost.attach(port=self.bench.server.port, timeout_s=timeout_s), call)


class _Unplugged(PortHost):
    """A host that has gone when `close` returns, as the contract's tests look at the camera next."""

    def __init__(self, bench, port, timeout_s):
        super().__init__(port, timeout_s)
        self._bench = bench

    def close(self):
        super().close()
        self._bench.until(lambda: self._bench.cable.idle)


class TestGadget(UsbContract):
    @pytest.fixture(autouse=True)
    def gadget(self):
        self.bench = GadgetBench()
        yield
        self.bench.close()

    def plug(self, device, timeout_s):
        port = self.bench.plug(device, self.camera.settings.descriptors())
        return Plugged(_Unplugged(self.bench, port, timeout_s), self.bench.call)


class TestFakeBus(UsbContract):
    def plug(self, device, timeout_s):
        bus = FakeUsbBus(device, self.camera.settings.descriptors())
        return Plugged(PyusbHost.find(0x152A, self.camera.product, bus, timeout_s), bus.call)


class TestLoopback(UsbContract):
    def plug(self, device, timeout_s):
        return Plugged(DirectHost(device), lambda function, *args: function(*args))


class TestDavis240cOnUsbip(TestUsbip):
    camera = DAVIS240C


class TestDavis240cOnGadget(TestGadget):
    camera = DAVIS240C


class TestDavis240cOnFakeBus(TestFakeBus):
    camera = DAVIS240C


class TestDavis240cOnLoopback(TestLoopback):
    camera = DAVIS240C


class TestDvxplorerOnUsbip(TestUsbip):
    camera = DVXPLORER


class TestDvxplorerOnGadget(TestGadget):
    camera = DVXPLORER


class TestDvxplorerOnFakeBus(TestFakeBus):
    camera = DVXPLORER


class TestDvxplorerOnLoopback(TestLoopback):
    camera = DVXPLORER


class TestMicroOnUsbip(TestUsbip):
    camera = DVXPLORER_MICRO


class TestMicroOnGadget(TestGadget):
    camera = DVXPLORER_MICRO


class TestMicroOnFakeBus(TestFakeBus):
    camera = DVXPLORER_MICRO


class TestMicroOnLoopback(TestLoopback):
    camera = DVXPLORER_MICRO
