"""Charts, maps and pictures of a run's report, each an element of its page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from emulator.report.charts import Axis, Chart, Lane, Mark, Quantiles, Share, number_text, quantile_chart, share_bar
from emulator.report.pictures import ColourScale, count_map, scene_picture
from emulator.rig.tables import Trigger
from emulator.run.report.content import Fate, Happening, ReportContent
from emulator.run.report.observation import INTERVAL_EDGES_US, BinnedCounts, Observation
from transports.link.deliveries import LatencySummary

_PICTURES = 6
_MOST_TIMES = 400  # of a train of edges
_LANES = {"fault": "faults", "trigger": "triggers", "command": "commands"}
_KINDS = {"fault": "fault", "trigger": "edge", "command": "change"}


def timeline(of: ReportContent, marked: Sequence[Happening]) -> str:
    """Return the rates of ON and OFF events over the whole bins of stream time, with what happened below; "" if empty.

    Below are lanes of the faults, triggers, commands and late steps, where there are any.
    """
    rates, seconds = of.seen.rates, of.result.sim_seconds
    bin_s = rates.bin_us * 1e-6
    bins = max(1, int(seconds / bin_s + 1e-9))
    events, ons = (rates.column(column)[:bins] for column in (Observation.EVENTS, Observation.ON))
    on, off = ons / bin_s, (events - ons) / bin_s
    lanes = list(_lanes(of, marked))
    if not len(on) and not lanes:
        return ""
    highest_hz = max(float(on.max(initial=0)), float(off.max(initial=0)))
    scales = ((1e6, "Mev/s"), (1e3, "kev/s"))
    scale, unit = next((named for named in scales if highest_hz >= named[0]), (1.0, "events/s"))
    end_s = max(seconds, len(on) * bin_s, 1e-3)
    y = Axis(unit, 0.0, highest_hz / scale * 1.08 or 1.0)
    text = f"Event rate over {seconds:.4g} s of stream time, at most {highest_hz:.4g} events/s of a polarity"
    text += "".join(f"; {len(lane.marks)} marks in the lane {lane.name}" for lane in lanes)
    edges = np.arange(len(on) + 1) * bin_s
    chart = Chart(Axis("stream time, s", 0.0, end_s), y, text, lanes=lanes)
    return chart.steps(edges, off / scale, "off").steps(edges, on / scale, "on").svg()


def _lanes(of: ReportContent, marked: Sequence[Happening]) -> Iterator[Lane]:
    counts = of.seen.counts
    edges = int(counts.column(Observation.EDGES).sum())
    late = int(counts.column(Observation.LATE).sum())
    for kind, name in _LANES.items():
        marks = [
            Mark(happening.t_s, happening.until_s, happening.label) for happening in marked if happening.lane == kind
        ]
        if kind == "trigger" and edges:
            edge_marks = _given(of.rig.trigger, of.result.sim_seconds) or _marks(counts, Observation.EDGES)
            yield Lane(f"{name}; edges taken: {edges}", _KINDS[kind], [*edge_marks, *marks])
        elif marks:
            yield Lane(f"{name}: {len(marks)}", _KINDS[kind], marks)
    if late:
        yield Lane(f"late steps: {late}", "late", _marks(counts, Observation.LATE))


def _marks(counts: BinnedCounts, column: int) -> list[Mark]:
    """Return a mark for each bin with a count."""
    bin_s = counts.bin_us * 1e-6
    return [Mark(float(k) * bin_s) for k in np.flatnonzero(counts.column(column))]


def _given(trigger: Trigger | None, seconds: float) -> list[Mark]:
    """Return a mark for each edge at a time that the rig gives; none for edges of a bus, which are only counted."""
    if trigger is None:
        return []
    trains = [(train.at_ms, train.every_ms, train.count) for train in trigger.edges]
    if trigger.period_ms:
        trains.append((trigger.period_ms, trigger.period_ms, 0))
    times_ms = [time for train in trains for time in _times_ms(*train, 1e3 * seconds)]
    return [Mark(time_ms * 1e-3) for time_ms in sorted(times_ms)]


def _times_ms(first_ms: float, every_ms: float, count: int, end_ms: float) -> Sequence[float]:
    """Return the times of a train of edges until an end; of very many some, at even distances."""
    if first_ms > end_ms or not every_ms:
        return [first_ms] if first_ms <= end_ms else []
    number = int((end_ms - first_ms) / every_ms) + 1
    number = min(number, count) if count else number
    times: list[float] = (first_ms + every_ms * np.arange(0, number, max(1, number // _MOST_TIMES))).tolist()
    return times


def letters(fates: Sequence[Fate]) -> list[str]:
    """Return a letter for each fate, from A on; from the 27th on with a number."""
    return [chr(65 + k % 26) + (str(k // 26) if k >= 26 else "") for k in range(len(fates))]


def fate_bars(fates: Sequence[Fate]) -> list[tuple[str, str]]:
    """Return (caption, bar) for the sensor and for each link, with the letters of `letters`."""
    keys, bars = letters(fates), []
    for link in dict.fromkeys(fate.link for fate in fates):
        link_fates = [(key, fate) for key, fate in zip(keys, fates, strict=True) if fate.link == link]
        total = sum(fate.events for _, fate in link_fates)
        name = f"link {link}" if link else "sensor"
        described = ", ".join(f"{key} {fate.fate} {fate.events}" for key, fate in link_fates)
        bar = share_bar([Share(key, fate.events, fate.kind) for key, fate in link_fates], f"{name}: {described}")
        caption = f"{name}: {number_text(total)} events {'received' if link else 'raised'}"
        bars.append((caption, bar))
    return bars


def latency_chart(of: ReportContent) -> str:
    """Return the latencies of each link, and the lead that the steps needed, with their bounds; "" without any."""
    bound = of.rig.verdict.max_latency_us or None
    rows = [
        Quantiles(f"{name}: event to socket", _values(link.latency), bound, "bound of p99")
        for name, link in of.result.links.items()
    ]
    lead = _values(of.result.lateness.lead_needed_us)
    if lead:
        rows.append(Quantiles("lead that steps needed", lead, of.rig.run.lead_us, "run.lead_us"))
    return quantile_chart([row for row in rows if row.values], "time, us")


def _values(latency: LatencySummary) -> list[tuple[str, float]]:
    quantiles = {"p50": latency.p50, "p99": latency.p99, "p99.9": latency.p999, "max": latency.max}
    return [(name, value) for name, value in quantiles.items() if value is not None]


def interval_chart(seen: Observation) -> str:
    """Return the histogram of intervals between events of one pixel; "" without any."""
    used = np.flatnonzero(seen.intervals)
    if not len(used):
        return ""
    first, last = used[0] // 10 * 10, min(-(-(used[-1] + 1) // 10) * 10, len(seen.intervals))
    edges, counts = INTERVAL_EDGES_US[first : last + 1], seen.intervals[first:last]
    x = Axis("time between two events of a pixel, us", float(edges[0]), float(edges[-1]), log=True)
    commonest_us = float(INTERVAL_EDGES_US[int(np.argmax(seen.intervals))])
    text = (
        f"Histogram of {int(counts.sum())} intervals between events of a pixel, most of them near {commonest_us:.3g} us"
    )
    y = Axis("intervals", 0.0, float(counts.max()) * 1.08)
    return Chart(x, y, text, height=130).steps(edges, counts, "ink").svg()


def pixel_maps(seen: Observation) -> str:
    """Return the maps of ON and OFF events of each pixel, with the scale of both."""
    scale = ColourScale(max(int(seen.on.max(initial=0)), int(seen.off.max(initial=0))))
    maps = count_map(seen.on, scale, "ON events of each pixel") + count_map(seen.off, scale, "OFF events of each pixel")
    return f'<div class="maps">{maps}</div>{scale.legend}'


def strip(seen: Observation) -> str:
    """Return a strip of pictures of the run; "" without any."""
    taken = seen.pictures.chosen(_PICTURES)
    pictures = (scene_picture(picture.light, picture.polarity, f"{picture.t_us * 1e-6:.3f} s") for picture in taken)
    return f'<div class="strip">{"".join(pictures)}</div>' if taken else ""
