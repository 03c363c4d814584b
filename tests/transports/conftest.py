"""What tests of links and recordings share: processes that begin as forks, since imports take most of their time."""

import multiprocessing

import pytest

from tests.forked_reader import Fork
from transports import guarded_reader

_IMPORTED = [
    "transports.can_bus.endpoint",
    "transports.file",
    "transports.gige.endpoint",
    "transports.network_streams.tcp",
    "transports.network_streams.udp",
    "transports.serial_line.endpoint",
    "transports.udp_packets.endpoint",
    "transports.usb.usbip.endpoint",
]


@pytest.fixture(autouse=True)
def forked_links(monkeypatch):
    """Links are forks of a process that has imported them; tests/evstim/test_link_contract.py has them as users do."""
    of_method, server = multiprocessing.get_context, multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(_IMPORTED)
    monkeypatch.setattr(
        multiprocessing, "get_context", lambda method=None: server if method == "spawn" else of_method(method)
    )


@pytest.fixture
def forked_readers(monkeypatch):
    """Readers are forks; `test_what_was_written_is_read_back` has those of every format as users have them."""
    monkeypatch.setattr(guarded_reader, "_start", Fork)
