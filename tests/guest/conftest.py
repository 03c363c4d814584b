"""The guest, booted once for all its tests; and what happens where it cannot be had."""

import os

import pytest

from emulator.run.machine import free_loopback_address
from firmware_protocol.gige.gvcp import GVCP_PORT
from tests.guest.environments import DRIVERS, EVENTCV
from tests.guest.gige_run import GigeRun
from tests.guest.image import GuestUnavailable
from tests.guest.machine import CACHE, Guest
from tests.guest.own_network import CAMERA, HOST, OwnNetwork


def cannot(reason):
    """Skip, saying why; but in CI nothing that counts is skipped."""
    if os.environ.get("CI") == "true":
        pytest.fail(f"the guest is not to be had: {reason}", pytrace=False)
    pytest.skip(f"the guest is not to be had: {reason}")


@pytest.fixture(scope="session")
def guest(tmp_path_factory):
    """A running Linux guest with the USB/IP host driver loaded."""
    try:
        machine = Guest(tmp_path_factory.mktemp("guest"))
    except GuestUnavailable as reason:
        cannot(reason)
        raise
    with machine:
        machine.load("vhci-hcd")
        yield machine


@pytest.fixture(scope="session")
def driver_pythons():
    """The interpreter of each driver's own environment, the same path in the guest as on the host."""
    try:
        return {driver.name: driver.python(CACHE) for driver in DRIVERS}
    except GuestUnavailable as reason:
        cannot(reason)
        raise


@pytest.fixture(scope="session")
def eventcv_python():
    """The interpreter of EventCV's own environment."""
    try:
        return EVENTCV.python(CACHE)
    except GuestUnavailable as reason:
        cannot(reason)
        raise


@pytest.fixture
def address():
    """A loopback address at which no GigE Vision camera is."""
    return free_loopback_address(GVCP_PORT)


@pytest.fixture
def start_gige(tmp_path, at_end):
    """Start runs on GigE Vision, which end with the test."""

    def start(*keys, **more):
        run = GigeRun(tmp_path, *keys, **more)
        at_end.callback(run.kill)
        return run

    return start


@pytest.fixture
def ends():
    """Yield the networks at the two ends of a cable: that of a camera, and that of a host."""
    with OwnNetwork() as camera, OwnNetwork() as host:
        camera.join(host, CAMERA, HOST)
        yield camera, host
