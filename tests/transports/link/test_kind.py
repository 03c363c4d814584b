"""The record of a kind of link refuses parameters that a run could not use."""

from dataclasses import dataclass, field
from typing import ClassVar

import pytest

from firmware_protocol.instrument.settings import InstrumentSettings
from transports.link.kind import LinkKind, LinkParameters, possible_faults


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
