"""Points of the time axis: rates of each interval, whole frames, and no gap for a viewer that misses messages."""

import numpy as np

from emulator.live_page.axis import RunHistory, TimeAxis
from emulator.run.outcome import RunStatus
from emulator.run.pacing import Lateness
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.frames import LineKind, line_record
from firmware_protocol.imu_samples import IMU_SAMPLE
from transports.faults.script import FaultRecord
from transports.link.report import LinkReport


def _status(t_s, read_out=0, faults=()):
    return RunStatus(t_s, t_s, 1, read_out, Lateness(), {"a": LinkReport("open", faults=faults)})


def _moments(*kinds_and_times):
    records = np.zeros(len(kinds_and_times), line_record(4))
    records["kind"], records["t"] = zip(*kinds_and_times, strict=True)
    return [(ReadingKind.FRAMES, records)]


def test_rates_are_of_the_interval_between_two_states():
    axis = TimeAxis(None, has_frames=False)
    axis.renew(_status(0.0))
    axis.renew(_status(0.1, 100))
    points = axis.renew(_status(0.2, 400))["points"]
    assert [round(point["rate"]) for point in points] == [1000, 3000]
    assert axis.renew(_status(0.2, 400))["points"] == points  # paused: time has not moved


def test_a_viewer_finds_two_seconds_in_each_state():
    axis = TimeAxis(None, has_frames=False)
    states = [axis.renew(_status(0.1 * k, k)) for k in range(200)]
    assert [round(point["t_s"], 1) for point in states[-1]["points"]] == [round(18.0 + 0.1 * k, 1) for k in range(20)]


def test_a_frame_has_its_times_also_where_its_lines_come_in_several_steps():
    axis = TimeAxis(None, has_frames=True)
    axis.take(_moments((LineKind.RESET, 900), (LineKind.START, 1000), (LineKind.EXPOSURE_START, 2000)))
    assert axis.renew(_status(0.0))["frames_read"] == []
    axis.take(_moments((LineKind.SIGNAL, 2500), (LineKind.EXPOSURE_END, 3000), (LineKind.END, 4000)))
    assert np.allclose(axis.renew(_status(0.1))["frames_read"], [[0.001, 0.002, 0.003, 0.004]])
    axis.take(_moments((LineKind.EXPOSURE_END, 5000), (LineKind.END, 6000), (LineKind.END, 7000)))  # without a start
    assert len(axis.renew(_status(0.2))["frames_read"]) == 1
    assert axis.renew(_status(9.0))["frames_read"] == []


def test_inertial_rates_are_means_in_degrees_a_second():
    axis = TimeAxis(2, has_frames=False)
    axis.renew(_status(0.0))
    samples = np.zeros(50, IMU_SAMPLE)
    samples["scale"] = 0x70
    samples["counts"][:, 4] = np.where(np.arange(50) % 2, 100, 300)  # 500 deg/s are 65536 / 2 ** range counts
    axis.take([(ReadingKind.IMU, samples)])
    (point,) = axis.renew(_status(0.1))["points"]
    assert round(point["imu_hz"]) == 500
    assert point["imu"] == [round(200 * 500 / 65536, 3), 0.0, 0.0]


def test_faults_of_the_rig_and_by_hand_are_there():
    axis = TimeAxis(None, has_frames=False)
    faults = tuple(FaultRecord(k, "stall", k * 1_000_000, None, 2, events_lost=5) for k in range(1, 50))
    shown = axis.renew(_status(1.0, faults=faults))["faults"]
    assert len(shown) == 30
    assert shown[-1] == {
        "link": "a", "number": 49, "kind": "stall", "began_s": 49.0, "ended_s": None, "hits": 2, "events_lost": 5,
    }  # fmt: skip


def _point(k):
    imu = [1.0, 2.0, float(k)] if k % 2 else None
    return {"t_s": 0.1 * k, "rate": k, "p50": k, "p99": k, "edges": k % 3, "imu_hz": 500, "imu": imu}


def _statuses(count):
    """Yield statuses with two points and frames each, so that each comes twice."""
    for k in range(1, count):
        yield {"points": [_point(k - 1), _point(k)], "frames_read": [[0, 0, 0, k - 1], [0, 0, 0, k]]}


def test_the_history_has_every_point_once():
    history = RunHistory()
    assert not any([history.take(status) for status in _statuses(1000)])
    assert history.as_json()["points"] == [_point(k) for k in range(1000)]
    assert history.as_json()["frames_read"] == [[0, 0, 0, k] for k in range(1000)]


def test_the_history_of_a_long_run_begins_at_its_start_and_does_not_grow():
    history, most, count = RunHistory(), 0, 30_000
    for status in _statuses(count):
        if history.take(status):
            most = max(most, len(history.as_json()["points"]))
    points = history.as_json()["points"]
    assert 1200 < most < 2500
    assert len(history.as_json()["frames_read"]) == 3000
    assert points[0]["t_s"] < 10
    assert points[-600:] == [_point(k) for k in range(count - 600, count)]
    assert [point["t_s"] for point in points] == sorted(point["t_s"] for point in points)
    assert sum(point["edges"] for point in points) == sum(k % 3 for k in range(count))
    joined = points[0]
    length = round(joined["t_s"] / 0.1) + 1
    assert joined["rate"] == sum(range(length)) / length
    assert (joined["p99"], joined["imu_hz"], joined["imu"][:2]) == (length - 1, 500, [1.0, 2.0])
