"""Messages between the page's server and a browser, without any I/O.

To the browser: binary pictures (below), and JSON texts with a `kind`.

    picture   "EVP2" | number u32 | width u16 | height u16 | from_us u64 | until_us u64 | events u32 | every u16 | 0 u16
              | active u32 | place (active,) u32 | light (height, width) u16 | last (active,) i8 | count (active,) u8
              little-endian

    light     linear light: the sign bit of a float32 is dropped and the next 16 bits are sent, rounded; so every level
              is within 0.2 % and the browser can choose the exposure
    place     the pixels with events in the interval, row * width + column, increasing
    last      +-1 to +-127: how late in the interval a pixel's last event was, the sign is the polarity
    count     ON events in the low four bits, OFF events in the high four, at most 15 each
    every     only one event in so many is drawn, where there are very many

From the browser: JSON texts, one object each, with `do`.

    {"do": "hello", "token": TEXT}              first of all; the token where the page needs one
    {"do": "seen", "number": N}                 the last message has been shown, so another may come
    {"do": "adjust", "name": NAME, "value": X}  a sensor parameter
    {"do": "pixel", "x": X, "y": Y}             thresholds of this pixel of the sensor
    {"do": "inject", "fault": {table}}          as in a rig
    {"do": "undo", "change": N}                 the change with this number in the list of changes
    {"do": "again", "seed": N}                  stop this run and start it again with this seed
    {"do": "stop"}                              end the run
    {"do": "trigger"} {"do": "pause"} {"do": "step"} {"do": "resume"}

Commands are carried out in the session's own thread.

Address and access of the page:

    --serve                       127.0.0.1 and a free port: programs on this machine only, no token
    --serve 127.0.0.1:8080
    --serve 0.0.0.0:8080          other machines can reach it: a token is made, and printed as part of the address

Any page that a browser shows could open a WebSocket to this machine. So the page's own Origin is required, and a Host
that is an address of this machine (a name that a foreign DNS server resolves to 127.0.0.1 is not).
"""

from __future__ import annotations

import dataclasses
import json
import math
import secrets
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt

from emulator.live_page.controls import ChangeList, Repeats
from emulator.run.outcome import RunStatus
from transports.network import is_loopback

if TYPE_CHECKING:
    from emulator.run.session import Session

MOST_COMMAND_BYTES = 4096
LIVE_PAGE = "live page"  # name of its viewers in the record of a run

_HEADER = struct.Struct("<4sIHHQQIHHI")
_MAGIC = b"EVP2"
NEWEST = 127
MOST_COUNT = 15
_FIELDS: dict[str, dict[str, type]] = {
    **{order: {} for order in ("trigger", "pause", "step", "resume", "stop")}, "seen": {"number": int},
    "pixel": {"x": int, "y": int}, "undo": {"change": int}, "again": {"seed": int}, "inject": {"fault": dict},
}  # fmt: skip
_CODE_SHIFT = 15  # bits of a float32 that a light code leaves out
_INFINITE = 0xFF00  # the code of infinity
_MOST_LIGHT = np.float32(1e38)


class BadMessage(ValueError):
    """A message that is not one of those above."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Light and events of one interval of stream time.

    Attributes
    ----------
    light : (height, width) uint16 codes, as made by `light_codes`.
    place : (active,) uint32, pixels with events, row * width + column, increasing.
    last, count : (active,) int8 and uint8.
    events : all events of the interval, drawn or not.
    every : one in so many of them is drawn.
    """

    number: int
    from_us: int
    until_us: int
    events: int
    every: int
    light: npt.NDArray[np.uint16]
    place: npt.NDArray[np.uint32]
    last: npt.NDArray[np.int8]
    count: npt.NDArray[np.uint8]

    def joined(self, then: Picture) -> Picture:
        """Return the picture of this interval and of the next one, with the light of the latter."""
        place, at = np.unique(np.concatenate((self.place, then.place)), return_inverse=True)
        early, late = at[: len(self.place)], at[len(self.place) :]
        share = (self.until_us - self.from_us) / max(then.until_us - self.from_us, 1)
        last = np.zeros(len(place))
        on, off = np.zeros((2, len(place)), np.uint8)
        last[early] = np.sign(self.last) * np.maximum(np.abs(self.last) * share, 1)
        last[late] = np.sign(then.last) * np.maximum(np.abs(then.last) * (1 - share) + NEWEST * share, 1)
        for part, picture in ((early, self), (late, then)):
            on[part] += picture.count & MOST_COUNT
            off[part] += picture.count >> 4
        count = np.asarray(np.minimum(on, MOST_COUNT) | np.minimum(off, MOST_COUNT) << 4, np.uint8)
        return dataclasses.replace(
            then, from_us=self.from_us, events=self.events + then.events, every=max(self.every, then.every),
            place=place, last=last.round().astype(np.int8), count=count,
        )  # fmt: skip


def light_codes(light: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    """Return linear light as codes; light that is negative or not a number is 0, infinite light is a large number."""
    codes = _rounded(light)
    if codes.max(initial=0) >= _INFINITE:  # so has a negative number, by its sign bit; both are rare, and slow
        codes = _rounded(np.fmin(np.fmax(light, np.float32(0)) + np.float32(0), _MOST_LIGHT))
    return codes.astype(np.uint16)


def _rounded(light: npt.NDArray[np.float32]) -> npt.NDArray[np.uint32]:
    return np.asarray((light.view(np.uint32) + (1 << _CODE_SHIFT - 1)) >> _CODE_SHIFT, np.uint32)


def encode_picture(picture: Picture) -> bytes:
    """Return a picture as the bytes of a message."""
    height, width = picture.light.shape
    header = _HEADER.pack(
        _MAGIC, picture.number & 0xFFFFFFFF, width, height, picture.from_us, picture.until_us, picture.events,
        picture.every, 0, len(picture.place),
    )  # fmt: skip
    planes = picture.place, picture.light, picture.last, picture.count  # the widest first: all are aligned
    return b"".join((header, *(plane.tobytes() for plane in planes)))


def parse_command(text: str) -> dict[str, Any]:
    """Return a browser's message, with the fields above and no others; raises BadMessage."""
    if len(text) > MOST_COMMAND_BYTES:
        raise BadMessage(f"a message has at most {MOST_COMMAND_BYTES} bytes")
    try:
        message = json.loads(text, parse_constant=_refused)
    except (ValueError, RecursionError) as error:
        raise BadMessage(f"this is no JSON: {error}") from error
    if not isinstance(message, dict):
        raise BadMessage("a JSON object is expected")
    return _checked(message)


def _refused(constant: str) -> float:
    raise ValueError(f"{constant} is no number")


def _checked(message: dict[str, Any]) -> dict[str, Any]:
    match message:
        case {"do": "hello", **rest}:
            token = rest.get("token", "")
            return {"do": "hello", "token": token if isinstance(token, str) else ""}
        case {"do": "adjust", "name": str(name), "value": int() | float() as value} if _is_number(value):
            return {"do": "adjust", "name": name, "value": float(value)}
        case {"do": str(order)} if order in _FIELDS:
            fields = {name: message.get(name) for name in _FIELDS[order]}
            if all(type(fields[name]) is kind for name, kind in _FIELDS[order].items()):
                return {"do": order, **fields}
    raise BadMessage("known are hello, seen, adjust, pixel, inject, undo, again, stop, trigger, pause, step and resume")


def _is_number(value: float) -> bool:
    try:
        return not isinstance(value, bool) and math.isfinite(float(value))
    except OverflowError:
        return False


_LARGEST = 1e9  # JSON has no infinity


Inject = Callable[[dict[str, Any], RunStatus], dict[str, Any]]
"""Answer to a request that begins or ends a fault, as `FaultInjection.answer`."""


class ViewerCommands:
    """Execution of the commands of viewers; `paused`: the run is to pause before its next step.

    Parameters
    ----------
    trigger : function that makes an edge on the cameras' external input, at a time of CLOCK_MONOTONIC (ns), with a
        number; None where the rig has a trigger of its own.
    can_pause : whether the run may be paused: only one that is not paced, and that no bus drives.
    repeats : receiver of the request for a new run; None where there can be none.
    """

    def __init__(
        self,
        session: Session,
        inject: Inject,
        trigger: Callable[[int, int], None] | None = None,
        *,
        can_pause: bool = False,
        repeats: Repeats | None = None,
    ) -> None:
        self._session = session
        self._inject = inject
        self._trigger = trigger
        self._triggers = 0
        self._can_pause = can_pause
        self._changes = ChangeList(session)
        self._repeats = repeats or Repeats("it was not started by `evstim run`")
        self.status: RunStatus | None = None
        self.paused = False
        self._steps = 0

    def state(self) -> dict[str, Any]:
        """Return the possible commands, and the state of the run."""
        return {
            "adjustable": {name: min(value, _LARGEST) for name, value in self._session.adjustable.items()},
            "can_trigger": self._trigger is not None,
            "triggers": self._triggers,
            "can_pause": self._can_pause,
            "paused": self.paused,
            "next_seed": self._repeats.seed,
            "no_repeat": self._repeats.obstacle,
            **self._changes.table({} if self.status is None else self.status.links),
        }

    def carry_out(self, command: dict[str, Any]) -> dict[str, Any]:
        """Execute a parsed command; return {"did": ...} or {"error": ...}."""
        try:
            return self._carried_out(command)
        except ValueError as error:
            return {"error": str(error)}

    def steps_allowed(self) -> bool:
        """Return whether the next step may begin; this uses up a requested single step."""
        if not self.paused or self._session.stopping:
            return True
        self._steps, allowed = max(self._steps - 1, 0), self._steps > 0
        return allowed

    def _carried_out(self, command: dict[str, Any]) -> dict[str, Any]:
        match command:
            case {"do": "adjust", "name": name, "value": value}:
                self._session.adjust(name, value, LIVE_PAGE)
                return {"did": f"{name} = {value:g}"}
            case {"do": "pixel", "x": x, "y": y}:
                thresholds = None  # where they cannot be read; [] for a dead pixel
                with suppress(ValueError):
                    thresholds = [level for level in self._session.thresholds_of(x, y) if math.isfinite(level)]
                return {"pixel": [x, y], "thresholds": thresholds}
            case {"do": "inject", "fault": fault}:
                return self._injected(fault)
            case {"do": "undo", "change": number}:
                return self._undone(number)
            case {"do": "again", "seed": seed}:
                self._repeats.request(seed)
                self._session.stop()
                return {"did": f"the run starts again with seed {seed}"}
            case {"do": "stop"}:
                self._session.stop()
                return {"did": "the run ends"}
            case {"do": "trigger"}:
                if self._trigger is None:
                    raise ValueError("this rig has a [trigger] of its own")
                self._triggers += 1
                self._trigger(time.monotonic_ns(), self._triggers)
                return {"did": f"trigger {self._triggers}"}
            case {"do": "pause" | "step" | "resume" as order}:
                return self._ordered(order)
        raise ValueError("a run cannot execute this command")

    def _injected(self, fault: dict[str, Any]) -> dict[str, Any]:
        if self.status is None:
            raise ValueError("the run has not begun")
        answer = self._inject({"request": "inject", "fault": fault}, self.status)
        return answer if "error" in answer else {"did": f"{fault.get('kind')} on {answer['link']}"}

    def _undone(self, number: int) -> dict[str, Any]:
        if self.status is None:
            raise ValueError("the run has not begun")
        change = self._changes.reversible(number, self.status.links)
        if not change.fault:
            assert change.before is not None
            self._session.adjust(change.what, change.before, f"{LIVE_PAGE}, undo")
            return {"did": f"{change.what} = {change.before:.4g} again"}
        answer = self._inject({"request": "end", "link": change.link, "number": change.fault}, self.status)
        return answer if "error" in answer else {"did": f"end of {answer['kind']} on {answer['link']}"}

    def _ordered(self, order: str) -> dict[str, Any]:
        if not self._can_pause:
            raise ValueError('only a run with pace = "free" that no bus drives can be paused: others follow a clock')
        self.paused = order != "resume"
        self._steps = 1 if order == "step" else 0
        return {"did": {"pause": "paused", "step": "one step", "resume": "resumed"}[order]}


_TOKEN_BYTES = 16


@dataclass(frozen=True)
class Address:
    """Address of the listening socket; port 0: a free one."""

    host: str = "127.0.0.1"
    port: int = 0


def parse_address(text: str) -> Address:
    """Return HOST:PORT, HOST, :PORT or [IPv6]:PORT as an address; raises ValueError."""
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ValueError(f"{text!r} is no HOST:PORT: {error}") from error
    if parts.username is not None or parts.path or parts.query or parts.fragment:
        raise ValueError(f"{text!r} is no HOST:PORT, such as 127.0.0.1:8080")
    return Address(host or "127.0.0.1", port or 0)


@dataclass(frozen=True)
class Access:
    """Access check of the page: by the token; without one, only pages that this machine itself has loaded."""

    token: str = ""

    @classmethod
    def for_host(cls, host: str) -> Access:
        """Return the access check of a page at `host`: with a new token where other machines can reach it."""
        return cls() if is_loopback(host) else cls(secrets.token_hex(_TOKEN_BYTES))

    def origin_permitted(self, origin: str | None, host: str | None) -> bool:
        """Return whether a WebSocket may be opened, from the headers Origin (None: no browser sent it) and Host."""
        if host is None:
            return False
        if not self.token and not _names_loopback(host):
            return False
        return origin is None or origin.partition("://")[2] == host

    def permits(self, token: str) -> bool:
        """Return whether this is the token, in a time that does not depend on it."""
        return not self.token or secrets.compare_digest(token.encode("utf-8", "surrogatepass"), self.token.encode())


def _names_loopback(host: str) -> bool:
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False
