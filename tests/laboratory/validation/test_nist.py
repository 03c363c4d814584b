"""NIST's tables and protocol on simulated sensors whose latencies are known."""

import csv
import dataclasses
import json
import math

import numpy as np
import pytest

from emulator.cli.app import _main
from emulator.sensor.chip.defects import at_temperature
from emulator.sensor.parameters import BackgroundParameters, JitterParameters, NoiseParameters
from emulator.sensor.presets import IMX636_W_M2, PRESETS, ReadoutParameters
from firmware_protocol.events import EVENT
from firmware_protocol.prophesee.biases import BiasSlopes
from laboratory.validation.nist import (
    Edges,
    Statistics,
    at_biases,
    first_latencies,
    pulsed,
    regions,
    statistics,
    table,
)
from laboratory.verbs.validate import EXPERIMENTS


def test_the_tables_hold_every_condition_and_their_origin():
    rows = table("nist_latency")
    conditions = {(row["lens"], row["polarity"], row["irradiance_w_m2"], row["diff_on"]) for row in rows}
    assert len(conditions) == len(rows) == 140
    assert {(row["lens"], row["side"]) for row in table("nist_region")} == {
        (k, s) for k in (0, 1) for s in (32, 64, 128, 256, 420)
    }
    assert all(row["median_lo"] <= row["median_us"] <= row["median_hi"] for row in rows)


def test_biases_change_the_thresholds_and_the_delay_of_off_events_alone():
    nist = PRESETS["imx636_nist"]
    p = at_biases(nist, BiasSlopes(), -42, 47)
    assert p.threshold_on == pytest.approx(nist.threshold_on * math.exp(-42 * 0.0143))
    assert p.threshold_off == pytest.approx(nist.threshold_off * math.exp(47 * 0.0136))
    assert p.jitter.off_latency_us == pytest.approx(nist.jitter.off_latency_us * math.exp(47 * 0.0445))
    thresholds = {name: getattr(nist, name) for name in ("threshold_on", "threshold_off")}
    assert dataclasses.replace(p, **thresholds, jitter=nist.jitter) == nist


def events(*rows):
    return np.array(list(rows), EVENT)


def test_first_events_after_an_edge_count_by_pixel_and_by_key():
    found = events((100, 0, 0, True), (110, 0, 0, True), (120, 10, 0, True), (125, 0, 1, True), (130, 1, 1, False))
    assert first_latencies(found, 90, True).tolist() == [10, 30, 35]
    assert first_latencies(found, 90, False).tolist() == [40]
    edges = Edges(found, np.array([-1, 90]), np.array([], np.int64))
    got = statistics(edges, True)
    # pixels (10, 0) and (0, 1) share the key 10, whose first event is at 120
    assert (got.median_us, got.least_us, got.most_us) == (20, 10, 30)
    assert got.responders == pytest.approx(2 / 9)
    assert got.opposite == pytest.approx(1 / 9)


def test_latencies_of_a_plain_pixel_are_those_of_its_law():
    p = dataclasses.replace(
        at_temperature(regions("imx636_nist")), mismatch=0.0, leak_hz=0.0, source_follower_hz=0.0,
        jitter=JitterParameters(), background=BackgroundParameters(),
        noise=NoiseParameters(), readout=ReadoutParameters(event_ns=0.001, row_ns=0), random_start=False,
    )  # fmt: skip
    edges = pulsed(p, 0.0457, 1, cycles=1)
    late_us = first_latencies(edges.after(int(edges.on_us[0])), int(edges.on_us[0]), True)
    assert late_us.size == 99 * 11
    dark, bright = p.dark_current_relative, 0.0457 / IMX636_W_M2 + p.dark_current_relative
    # w = e^-V follows w' + K i w = K: from 1 / dark to e^-threshold / dark
    shares = (1 / dark - 1 / bright) / (math.exp(-p.threshold_on) / dark - 1 / bright)
    assert late_us == pytest.approx(1e6 * math.log(shares) / (2 * math.pi * p.corner_hz_at_reference * bright), abs=1.5)


def test_validate_writes_its_pages_over_seeds_and_prints_the_counts(tmp_path, capsys, monkeypatch):
    assert list(EXPERIMENTS)[:2] == ["latency", "region"]
    monkeypatch.setattr("laboratory.validation.latency.latencies", lambda *condition: (_same(condition[-1]),) * 2)
    assert _main(["validate", "latency", "spread", "--seeds", "2", "--out", str(tmp_path), "--json"]) == 0
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last["within"]["Spread of latencies in a region, predicted"] == "14 of 20"
    assert last["within"]["Latency over light and biases, fitted"].endswith("of 70")
    rows = list(csv.DictReader((tmp_path / "validation" / "validation.csv").read_text().splitlines()))
    assert len(rows) == 140 + 40
    assert (rows[0]["least"], rows[0]["largest"]) == ("50.0", "51.0")
    assert (tmp_path / "worth.md").exists()
    assert (tmp_path / "validation" / "latency.png").exists()
    assert _main(["validate", "nothing", "--out", str(tmp_path)]) == 2
    assert _main(["validate", "spread", "--seeds", "0", "--out", str(tmp_path)]) == 2


@pytest.mark.system
@pytest.mark.parametrize(
    ("name", "unit", "counted", "least"),
    [("opposite", "of 111", (3, 100), 22), ("latency", "us", (0, 1e6), 60), ("gen31", "us", (0, 1e6), 15),
     ("gen31", "of 111", (0, 100), 17)],
)  # fmt: skip
def test_each_unit_is_near_its_camera(name, unit, counted, least):
    """Of 24, 70, 18 and 18 rows; a part of the counts of pixels shows nothing: none, or all that are counted."""
    rows = [one for one in EXPERIMENTS[name](1).rows(True) if one.unit == unit and counted[0] <= one.real < counted[1]]
    assert len(rows) in (24, 70, 18)
    assert sum(one.alike for one in rows) >= least


def _same(seed):
    return Statistics(49.0 + seed, 25.0, 100.0, 55.0, 111.0, 3.0)
