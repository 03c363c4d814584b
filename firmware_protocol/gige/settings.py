"""What a GigE Vision camera is told when it is made."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field

from firmware_protocol.imx636.bias_effects import BiasModel

__all__ = ["GigeSettings"]


@dataclass(frozen=True)
class GigeSettings:
    """Identity and buffers of a camera.

    Attributes
    ----------
    size
        (width, height) of the sensor, pixels.
    address
        The camera's own IPv4 address, which it tells in its answer to a discovery.
    serial, user_name
        At most 15 ASCII characters.
    start_delay_us
        Silence after AcquisitionStart: a host with the stock socket buffer begins to read some 0.1 s later.
    block_us
        A block is closed when it is that old, or full.
    capacity
        Events that wait at most; further ones are dropped and counted.
    biases
        What biases do to the sensor.
    """

    size: tuple[int, int] = (1280, 720)
    address: str = "127.0.0.1"
    serial: str = "00000636"
    user_name: str = ""
    start_delay_us: int = 300_000
    block_us: int = 1000
    capacity: int = 1 << 20
    biases: BiasModel = field(default_factory=BiasModel)

    def __post_init__(self) -> None:
        ipaddress.IPv4Address(self.address)
        for name in ("serial", "user_name"):
            if len(getattr(self, name)) > 15 or not getattr(self, name).isascii():
                raise ValueError(f"{name} must have at most 15 ASCII characters, got {getattr(self, name)!r}")
        if self.start_delay_us < 0 or self.block_us < 1 or self.capacity < 1:
            raise ValueError("start_delay_us must not be negative, block_us and capacity be at least 1")
