"""Status and result of a run, the fates of its events, and its verdict.

Each event raised has exactly one fate, and the sums must agree at every stop:

    raised  = lost_in_pixel + lost_at_readout + read_out
    read_out = dropped_in_device + delivered + dropped          for every link, which each carry the whole stream

lost_in_pixel      crossings beyond the limit of one pixel in one step
lost_at_readout    the pixel crossed again while its earlier event still waited to be read out, or was busy: in the
                   refractory period that begins when the read-out acknowledges an event (reset.at_acknowledge)
dropped_in_device  the camera was not running, its FIFO was full, or it was flushed at a stop
dropped            lost by the link: its ring was full, or the bytes had left the camera when the host went away

The verdict has rules that hold for every run, and those of the rig's [verdict] table. The share of undersampled
pixel-steps has the same text on the terminal and in the report.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

from emulator.run.changes import Change
from emulator.run.pacing import Lateness
from firmware_protocol.events import Kept
from transports.link.report import LinkReport


@dataclass(frozen=True)
class LinkLedger:
    """The fates of the events that one link was given."""

    name: str
    delivered: int
    dropped: int
    dropped_in_device: int

    @property
    def total(self) -> int:
        """Events accounted for."""
        return self.delivered + self.dropped + self.dropped_in_device

    def as_json(self) -> dict[str, int]:
        """Return the object of a link in the `events` object."""
        return {"delivered": self.delivered, "dropped": self.dropped, "dropped_in_device": self.dropped_in_device}


@dataclass(frozen=True)
class Ledger:
    """The fates of all events of a run; `second`: those of a second camera, which has links of its own."""

    raised: int
    lost_in_pixel: int
    lost_at_readout: int
    read_out: int
    links: tuple[LinkLedger, ...] = ()
    second: Ledger | None = None

    @property
    def dropped_in_device(self) -> int:
        """Events dropped inside cameras, summed over the links."""
        return sum(link.dropped_in_device for link in self.links)

    @property
    def imbalance(self) -> int:
        """Events without a fate, or with two: zero in a sound run."""
        sensor = self.raised - self.lost_in_pixel - self.lost_at_readout - self.read_out
        beside = 0 if self.second is None else self.second.imbalance
        return abs(sensor) + sum(abs(self.read_out - link.total) for link in self.links) + beside

    @property
    def balanced(self) -> bool:
        """True when every event has exactly one fate."""
        return self.imbalance == 0

    def as_json(self) -> dict[str, object]:
        """The `events` object of `evstim run --json`."""
        return {
            "raised": self.raised, "lost_in_pixel": self.lost_in_pixel, "lost_at_readout": self.lost_at_readout,
            "dropped_in_device": self.dropped_in_device, "read_out": self.read_out,
            "links": {link.name: link.as_json() for link in self.links},
            **({} if self.second is None else {"second_camera": self.second.as_json()}),
        }  # fmt: skip


@dataclass(frozen=True)
class RunStatus(Kept):
    """Counts of a run so far, for the live table."""

    sim_seconds: float
    wall_seconds: float
    frames: int
    read_out: int
    lateness: Lateness
    links: dict[str, LinkReport]
    raised: int = 0
    lost_in_pixel: int = 0
    lost_at_readout: int = 0


_STRETCHED_SHARE = 0.01  # fewer longer steps than this change no result
_WINDOW = 10  # statuses over which rates are averaged


class Rates:
    """Rates of a run over the last second."""

    def __init__(self) -> None:
        self._past: deque[tuple[float, float, int, int, int]] = deque(maxlen=_WINDOW)

    def renew(self, status: RunStatus) -> dict[str, float]:
        """Return events and seconds of stream, each for a second, and the number of steps and of late ones."""
        now = status.sim_seconds, status.wall_seconds, status.read_out, status.frames, status.lateness.frames_late
        self._past.append(now)
        sim_s, wall_s, events, steps, late = (value - first for value, first in zip(now, self._past[0], strict=True))
        return {
            "events_per_s": events / sim_s if sim_s > 0 else 0.0,
            "real_time_factor": sim_s / wall_s if wall_s > 0 else 0.0,
            "steps": steps,
            "steps_late": late,
        }


@dataclass(frozen=True)
class RunResult(Kept):
    """Result of a run.

    Attributes
    ----------
    changes, changes_beyond : changes from outside, and the number of further ones that are not listed.
    scene_trouble : reason why the scene gave no more light before the end of the run; "" if it did.
    """

    sim_seconds: float
    wall_seconds: float
    frames: int
    steps: int
    ledger: Ledger
    lateness: Lateness
    links: dict[str, LinkReport] = field(default_factory=dict)
    undersampled_share: float | None = None
    scene_counts: Mapping[str, int] = field(default_factory=dict)
    syncs: int | None = None
    painter: Literal["cpu", "gl"] = "cpu"
    renderer: str | None = None
    max_late_us: float = 0.0
    max_late_share: float = 1.0
    changes: tuple[Change, ...] = ()
    changes_beyond: int = 0
    scene_trouble: str = ""

    @property
    def late_share(self) -> float:
        """Share of the steps that were ready after they were due."""
        return self.lateness.frames_late / self.steps if self.steps else 0.0

    @property
    def step_too_late(self) -> bool:
        """True when a step was later than the schedule allows."""
        return 0 < self.max_late_us < self.lateness.worst_gap_us

    @property
    def late_too_often(self) -> bool:
        """True when more steps were late than the schedule allows."""
        return self.max_late_us > 0 and self.late_share > self.max_late_share

    @property
    def often_stretched(self) -> bool:
        """True when so many steps were made longer that the result may have changed."""
        return self.lateness.steps_stretched > _STRETCHED_SHARE * self.steps

    @property
    def drawn_by(self) -> str:
        """The painter in words, with GL's name of its renderer."""
        return f"GL: {self.renderer}" if self.painter == "gl" else self.renderer or "the CPU"

    @property
    def too_late(self) -> bool:
        """True when the run has not kept up with real time, by either limit."""
        return self.step_too_late or self.late_too_often

    @property
    def good(self) -> bool:
        """True when all events, edges and readings have one fate, no link failed, files are whole, the run kept up."""
        return all(judgement.good for judgement in _always(self))


@dataclass(frozen=True)
class Judgement:
    """One rule and its result.

    Attributes
    ----------
    rule : its name, the same in every report.
    good : whether the run kept it.
    finding : limit and measured value, for people.
    figure : the measured value; None for a rule without one, or where nothing was measured.
    bound : its limit; None for a rule without one.
    unit : of both.
    side : of the bound on which the figure has to be, "at most" or "at least"; empty without a bound.
    """

    rule: str
    good: bool
    finding: str
    figure: float | None = None
    bound: float | None = None
    unit: str = ""
    side: Literal["", "at most", "at least"] = ""

    def as_json(self) -> dict[str, object]:
        """Return an element of `rules` of `evstim run --json`."""
        limit = {"figure": self.figure, "side": self.side, "bound": self.bound, "unit": self.unit}
        return {"rule": self.rule, "good": self.good, "told": self.finding, **limit}


class Limits(Protocol):
    """Limits of a good run, as `emulator.rig.tables.Verdict` declares them for a rig; 0 sets no limit."""

    @property
    def max_drop(self) -> float:
        """Share of the events that a link may lose; negative: any."""

    @property
    def min_rate_hz(self) -> float:
        """Least mean event rate at the read-out."""

    @property
    def max_rate_hz(self) -> float:
        """Greatest mean event rate at the read-out."""

    @property
    def max_latency_us(self) -> float:
        """Greatest 99th percentile of the time from an event to its bytes, on any link."""

    @property
    def max_undersampled(self) -> float:
        """Greatest share of the solved pixel-steps whose light may have changed unseen."""


def judge(rules: Limits, result: RunResult) -> tuple[Judgement, ...]:
    """Return every rule that was applied to a run that has ended."""
    return (*_always(result), *_own(rules, result))


def good(judgements: tuple[Judgement, ...]) -> bool:
    """Return whether all rules were kept."""
    return all(judgement.good for judgement in judgements)


def _always(result: RunResult) -> Iterator[Judgement]:
    imbalance = result.ledger.imbalance
    finding = "balanced" if not imbalance else f"off by {imbalance} events"
    yield Judgement("ledger", not imbalance, finding, imbalance, 0, "events without one fate", "at most")
    if result.scene_trouble:
        yield Judgement("scene", good=False, finding=result.scene_trouble)
    for name, link in result.links.items():
        trouble = [link.error] if link.error is not None else []
        trouble += [] if link.edges_balanced else ["edges without a fate"]
        trouble += [] if link.readings_balanced else ["frames or samples without a fate"]
        trouble += link.file_troubles
        finding = "; ".join(trouble) or "sound"
        yield Judgement(f"link {name}", not trouble, finding, len(trouble), 0, "faults", "at most")
    if result.max_late_us > 0:
        worst_ms = result.lateness.worst_gap_us * 1e-3
        bound_ms = result.max_late_us * 1e-3
        finding = f"worst step {worst_ms:.1f} ms late, run.max_late_ms is {bound_ms:g}"
        yield Judgement("in real time", not result.step_too_late, finding, worst_ms, bound_ms, "ms", "at most")
        late = f"{result.lateness.frames_late} of {result.steps} steps late ({result.late_share:.3g})"
        finding = f"{late}, run.max_late_share is {result.max_late_share:g}"
        figures = (result.late_share, result.max_late_share, "of the steps")
        yield Judgement("steps in time", not result.late_too_often, finding, *figures, "at most")


def _own(rules: Limits, result: RunResult) -> Iterator[Judgement]:
    if rules.max_drop >= 0:
        yield from (_drop(rules.max_drop, result, name, link) for name, link in result.links.items())
    rate_hz = result.ledger.read_out / result.sim_seconds if result.sim_seconds else 0.0
    if least_hz := rules.min_rate_hz:
        finding = f"{rate_hz:.4g} events/s, at least {least_hz:g}"
        yield Judgement("verdict.min_rate_hz", rate_hz >= least_hz, finding, rate_hz, least_hz, "events/s", "at least")
    if most_hz := rules.max_rate_hz:
        finding = f"{rate_hz:.4g} events/s, at most {most_hz:g}"
        yield Judgement("verdict.max_rate_hz", rate_hz <= most_hz, finding, rate_hz, most_hz, "events/s", "at most")
    if rules.max_latency_us:
        yield from (_latency(rules.max_latency_us, name, link) for name, link in result.links.items())
    if rules.max_undersampled and result.undersampled_share is not None:
        share = result.undersampled_share
        finding = f"{share:.3g} of the solved pixel-steps, at most {rules.max_undersampled:g}"
        figures = (share, rules.max_undersampled, "of the pixel-steps")
        yield Judgement("verdict.max_undersampled", share <= rules.max_undersampled, finding, *figures, "at most")


def _drop(limit: float, result: RunResult, name: str, link: LinkReport) -> Judgement:
    """Judge the losses of a link; events that came while no host was streaming, or were not selected, do not count."""
    in_camera = 0 if link.camera is None else link.camera.dropped_for_room
    lost = link.dropped + in_camera
    counted = lost + link.delivered
    share = lost / counted if counted else 0.0
    finding = f"{lost} of {counted} events lost ({share:.3g}), at most {limit:g}"
    return Judgement(f"verdict.max_drop {name}", share <= limit, finding, share, limit, "of the events", "at most")


def _latency(most_us: float, name: str, link: LinkReport) -> Judgement:
    p99_us = link.latency.p99
    rule = f"verdict.max_latency_us {name}"
    if p99_us is None:
        return Judgement(rule, True, "nothing was sent", None, most_us, "us (p99)", "at most")
    finding = f"99th percentile {p99_us:.0f} us, at most {most_us:g}"
    return Judgement(rule, p99_us <= most_us, finding, p99_us, most_us, "us (p99)", "at most")


_MANY = 0.1  # above it, shorter steps for all pixels are cheaper than refining single ones


def undersampled_advice(result: RunResult) -> str:
    """Return advice where the share is large; "" where it is not. In a late run it follows from lateness."""
    share = result.undersampled_share
    if share is None or share <= _MANY:
        return ""
    remedy = "shorten run.step_us, or give run.tolerance_us"
    if result.too_late or result.often_stretched:
        stretched = result.lateness.steps_stretched
        remedy = f"the run was late, and {stretched} of {result.steps} steps were made longer: let it keep up first"
    return (
        f"light frames too far apart: in {share:.0%} of the solved pixel-steps the light changed unseen between them; "
        f"{remedy}"
    )
