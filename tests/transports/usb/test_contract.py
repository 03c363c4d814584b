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


for _name, _camera in (("Davis240c", DAVIS240C), ("Dvxplorer", DVXPLORER), ("Micro", DVXPLORER_MICRO)):
    for _cable in (TestUsbip, TestGadget, TestFakeBus, TestLoopback):
        _test = f"Test{_name}On{_cable.__name__[4:]}"
        globals()[_test] = type(_test, (_cable,), {"camera": _camera, "__module__": __name__})
del _cable
