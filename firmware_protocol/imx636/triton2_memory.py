"""The memory of a Triton2 EVS: the features that hosts find in it, power-on values, and rules for writes.

    features() --> Description --> zipped XML, an area of the memory
    triton2_areas()                power-on values of all registers
    triton2_rules()                value written --> value stored, or Refused

It imports neither numpy nor the event code; see `triton2_control`.
"""

from __future__ import annotations

from firmware_protocol.gige.description import (
    TRANSPORT,
    Description,
    Feature,
    Model,
    identity_features,
    stream_features,
    time_features,
)
from firmware_protocol.gige.gvsp import BLOCK_OCTETS
from firmware_protocol.gige.registers import DeviceIdentity, Rule, between, no_value, standard_areas, standard_rules
from firmware_protocol.imx636.triton2_registers import (
    ACQUISITION_START,
    ACQUISITION_STOP,
    BIASES,
    COLUMNS,
    INVERTED,
    MOST_RANGES,
    NOTIFY_WITH_DATA,
    PERIOD_US,
    ROWS,
    TEMPERATURE,
    Erc,
    Evs,
    Triton2Settings,
)

__all__ = ["evs_rules", "features", "triton2_areas", "triton2_rules"]


_CELSIUS = 35
_MODEL = Model("TRT009S-E", "Lucid", "5f3d7a10-636e-4d11-8a52-0f3e1c0faf01", "5f3d7a10-636e-4d11-8a52-0f3e1c0faf02")
_BIAS_TIPS = {
    "diff_on": "Threshold of ON events: higher means fewer",
    "diff_off": "Threshold of OFF events: higher means fewer",
    "diff": "Reference level of the comparators; do not change it",
    "refr": "Refractory period: higher means shorter",
    "fo": "Low-pass cut-off: higher means faster",
    "hpf": "High-pass cut-off: higher means that slow changes are suppressed",
}


def features(size: tuple[int, int]) -> list[Feature]:
    """Return all features of a camera whose sensor has `size` = (width, height) pixels."""
    events = [*_biases(), *_rate_control(), *_messages()]
    device = [*identity_features(), *_picture(size), *time_features(), *_acquisition()]
    payload = Feature("PayloadSize", TRANSPORT, "integer", Evs.PAYLOAD_SIZE, "Most octets of a block", False)
    return [*device, *events, payload, *stream_features(), _temperature()]


def _picture(size: tuple[int, int]) -> list[Feature]:
    return [
        Feature("Width", "ImageFormatControl", "integer", Evs.WIDTH, "Columns", False, limits=(0, size[0])),
        Feature("Height", "ImageFormatControl", "integer", Evs.HEIGHT, "Rows", False, limits=(0, size[1])),
        Feature(
            "EventFormat", "ImageFormatControl", "enumeration", Evs.EVENT_FORMAT, "Encoding", entries={"EVT3_0": 0}
        ),
        Feature(
            "EventFormatSize", "ImageFormatControl", "enumeration", Evs.EVENT_FORMAT_SIZE, "Word", False,
            entries={"Bpe16": 0},
        ),
    ]  # fmt: skip


def _acquisition() -> list[Feature]:
    group = "AcquisitionControl"
    return [
        Feature("AcquisitionMode", group, "enumeration", Evs.MODE, "Mode", entries={"Continuous": 0}),
        Feature("AcquisitionStart", group, "command", ACQUISITION_START, "Starts the stream; time begins at zero"),
        Feature("AcquisitionStop", group, "command", ACQUISITION_STOP, "Stops the stream"),
    ]


def _biases() -> list[Feature]:
    return [
        Feature(one.feature, "EventControl", "integer", one.address, _BIAS_TIPS[name], limits=(one.least, one.most))
        for name, one in BIASES.items()
    ]


def _rate_control() -> list[Feature]:
    group = "EventControl"
    return [
        Feature("ErcEnable", group, "boolean", Erc.ON, "Limits the rate of events", limits=(0, 1)),
        Feature("ErcReferencePeriod", group, "integer", Erc.PERIOD_US, "Period, us", limits=(1, 1 << 20)),
        Feature("ErcEventsPerPeriod", group, "integer", Erc.EVENTS, "Events a period", limits=(0, (1 << 31) - 1)),
    ]


def _messages() -> list[Feature]:
    group = "EventControl"
    states = {"Off": 0, "On": 1, "OnWithData": NOTIFY_WITH_DATA}
    return [
        Feature(
            "EventSelector", group, "enumeration", Evs.EVENT_SELECTOR, "Selected event",
            entries={"Line0AnyEdge": 0},
        ),
        Feature("EventNotification", group, "enumeration", Evs.EVENT_NOTIFICATION, "Notification", entries=states),
    ]  # fmt: skip


def _temperature() -> Feature:
    return Feature(
        "DeviceTemperature", "DeviceControl", "integer", TEMPERATURE, "", False, limits=(-4096, 4095), per_unit=16
    )


def triton2_areas(settings: Triton2Settings) -> dict[int, bytes]:
    """Return the areas of a camera's memory at power-on."""
    description = Description(_MODEL, features(settings.size))
    areas = standard_areas(_identity(settings), description.location) | _evs_areas(settings.size)
    return areas | {description.address: description.octets}


def _identity(settings: Triton2Settings) -> DeviceIdentity:
    return DeviceIdentity(
        "Lucid Vision Labs", _MODEL.name, "1.46.0.0", settings.serial, settings.user_name, settings.address, 0x1C0FAF
    )


def _evs_areas(size: tuple[int, int]) -> dict[int, bytes]:
    """Return the areas of the registers beyond those of every device."""
    biases = bytearray(0x14 * len(BIASES))
    for bias in BIASES.values():
        offset = bias.address - 0x13F3_0000
        biases[offset + 4 : offset + 12] = _signed(bias.least) + _signed(bias.most)
    rate = bytearray(0x40)
    rate[4:8] = PERIOD_US.to_bytes(4, "big")
    acquisition = bytearray(0x40)
    for register, value in ((Evs.PAYLOAD_SIZE, BLOCK_OCTETS), (Evs.WIDTH, size[0]), (Evs.HEIGHT, size[1])):
        acquisition[register - Evs.MODE : register - Evs.MODE + 4] = value.to_bytes(4, "big")
    return {
        TEMPERATURE: _signed(16 * _CELSIUS),
        Evs.MODE: bytes(acquisition),
        0x13F3_0000: bytes(biases),
        Erc.ON: bytes(rate),
        ROWS.on: bytes(0x100),
    }


def _signed(value: int) -> bytes:
    return value.to_bytes(4, "big", signed=True)


def triton2_rules(size: tuple[int, int]) -> dict[int, Rule]:
    """Return the rules of all registers that a host may write, by address."""
    rules = standard_rules() | evs_rules(size)
    return rules | dict.fromkeys((ACQUISITION_START, ACQUISITION_STOP), no_value)


def evs_rules(size: tuple[int, int]) -> dict[int, Rule]:
    """Return the rules of the registers beyond those of every device, except start and stop."""
    rules = {bias.address: between(bias.least, bias.most) for bias in BIASES.values()}
    rules |= {Evs.MODE: between(0, 0), Evs.EVENT_FORMAT: between(0, 0), INVERTED: between(0, 1)}
    rules |= {Erc.ON: between(0, 1), Erc.PERIOD_US: between(1, 1 << 20), Erc.EVENTS: between(0, (1 << 31) - 1)}
    rules |= {
        Erc.DROP_MODE: between(0, 4),
        Evs.EVENT_SELECTOR: between(0, 0),
        Evs.EVENT_NOTIFICATION: between(0, NOTIFY_WITH_DATA),
    }
    for registers, pixels in ((ROWS, size[1]), (COLUMNS, size[0])):
        rules |= {
            registers.on: between(0, 1),
            registers.selector: between(0, MOST_RANGES - 1),
            registers.size: between(0, pixels),
            registers.offset: between(0, pixels),
            registers.count: between(0, MOST_RANGES),
        }
    return rules
