"""The record of a kind of link refuses parameters that a run could not use."""

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest

from firmware_protocol.events import empty_edges
from firmware_protocol.instrument.event_path import block_settings
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.network_streams.coders import StreamFacts
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.telemetry.writing import BlockEncoder
from tests.made_events import scattered
from transports.can_bus.kind import CanLink
from transports.gige.kind import GigeLink
from transports.link.kind import EVENT_OCTETS, CameraFacts, LinkKind, LinkParameters, possible_faults
from transports.network_streams.kind import CONNECTION_CODERS, DATAGRAM_CODERS, TcpLink, UdpLink
from transports.serial_line.kind import SerialLink
from transports.udp_packets.kind import UdpPacketsLink
from transports.usb.kind import UsbGadgetLink, UsbipLink


@dataclass(frozen=True)
class Nameless:
    kind: ClassVar[str] = "beacon"


@dataclass(frozen=True)
class Kindless:
    name: str = "beacon"


@dataclass(frozen=True)
class Bare(LinkParameters):
    kind: ClassVar[str] = "beacon"
    name: str = "beacon"


@dataclass(frozen=True)
class Whole(Bare):
    instrument: InstrumentSettings = field(default_factory=InstrumentSettings)


@pytest.mark.parametrize(
    ("parameters", "serves", "told"),
    [(Nameless, "usb", "need name"), (Kindless, "usb", "`kind`"), (Bare, "instrument", "need instrument")],
)
def test_parameters_that_lack_something(parameters, serves, told):
    with pytest.raises(ValueError, match=told):
        LinkKind(parameters, serves, "beacon:factory_of")


@pytest.mark.parametrize(("parameters", "serves"), [(Bare, "usb"), (Whole, "instrument")])
def test_parameters_that_have_all(parameters, serves):
    kind = LinkKind(parameters, serves, "beacon:factory_of")
    assert kind.name == "beacon"
    assert possible_faults(kind, parameters()) == {}
    assert parameters().listens_on() is None


CAMERA = CameraFacts("davis346", (346, 260))


def spread_events(count, rate_hz):
    """Return events that are spread evenly over the pixels of CAMERA and over time."""
    return scattered(np.sort(np.random.default_rng(1).integers(0, round(count / rate_hz * 1e6), count)) + 1)


@pytest.mark.parametrize(
    "settings", [{}, {"tick_us": 100}, {"coding": "flat"}, {"block_events": 20}, {"block_bytes": 100}]
)
@pytest.mark.parametrize("baud", [115_200, 3_000_000])
def test_a_serial_line_carries_the_events_that_its_packets_hold(baud, settings):
    """An encoder and a profile make packets of as many events as the line should carry a second: these fill it."""
    instrument = InstrumentSettings(**settings)
    carried_hz = SerialLink(baud=baud, instrument=instrument).carries_hz(CAMERA)
    events, octets, count = spread_events(4000, carried_hz), 0, 0
    encoder, profile = BlockEncoder(CAMERA.size, block_settings(instrument)), Profile("ccsds-cobs")
    while len(events) - count >= 1000:
        block, taken = encoder.encode(events[count:])
        octets += len(profile.wrap(Message(MessageKind.EVENTS, block, 0)))
        count += taken
    assert octets / count * carried_hz == pytest.approx(baud / 10, rel=0.05)


@pytest.mark.parametrize("form", EVENT_OCTETS)
def test_octets_of_an_event_are_those_of_its_coder(form):
    facts, events = StreamFacts(CAMERA.size, "camera", form=form), spread_events(5000, 1e6)
    if form in DATAGRAM_CODERS:
        octets = sum(len(sent.data) for sent in DATAGRAM_CODERS[form](facts).encode(events, empty_edges()))
    else:
        octets = len(CONNECTION_CODERS[form](facts).encode(events, empty_edges()))
    assert octets / len(events) == pytest.approx(EVENT_OCTETS[form], rel=0.1)


FD = {"fd": True, "interface": "socketcan"}


@pytest.mark.parametrize(
    ("link", "measured_hz"),
    [
        (CanLink(), 15_900),  # docs/instrument.md "Bus load", whose events are of one polarity
        (CanLink(carriage="isotp"), 18_900),
        (CanLink(carriage="cfp"), 18_500),
        (CanLink(**FD), 125_000),
        (CanLink(carriage="isotp", **FD), 149_000),
        (CanLink(bitrate=500_000), 7950),
        (UdpLink(mbit_s=10.0), 156_250),
        (UdpPacketsLink(mbit_s=0.9216), 34_500),
        (GigeLink(mbit_s=100.0), 2_500_000),
        (UsbGadgetLink(), 80_000_000),
        (SerialLink(format="evt2", baud=400_000), 10_000),
        (SerialLink(instrument=InstrumentSettings(rate_limit=500)), 500),
        (CanLink(instrument=InstrumentSettings(rate_limit=500)), 500),
        (TcpLink(), math.inf),
        (UsbipLink(), math.inf),
    ],
)
def test_a_line_carries_about_what_was_measured(link, measured_hz):
    assert link.carries_hz(CAMERA) == pytest.approx(measured_hz, rel=0.17)
