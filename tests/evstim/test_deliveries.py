"""What one link of a run delivers, read by the program during the run: events, triggers, IMU samples and frames."""

import dataclasses
import os
import signal

import numpy as np
import pytest

import evstim
from tests.npz_records import load_edges, load_frames, load_imu

SCENE = evstim.CheckerboardScene(square_px=8.0, speed_px_s=200.0)


def camera(**tables):
    """Return a camera whose sensor has the size that drivers of a DAVIS346 read."""
    return evstim.Camera(**tables)


def rig(link, **tables):
    return evstim.Rig("mine", "one link", SCENE, links=(link,), **tables)


def joined(deliveries, name):
    return np.concatenate([getattr(one, name) for one in deliveries])


def test_all_streams_are_those_of_the_record(tmp_path):
    """A rig of one file link: frames, samples and edges beside events, as the record of the same link has them."""
    made = rig(
        evstim.FileLink(path=str(tmp_path / "own.npz")),
        camera=camera(imu=evstim.ImuParameters(), frames=evstim.FrameParameters()),
        trigger=evstim.Trigger(period_ms=10.0),
    )
    record = tmp_path / "record.npz"
    with evstim.run(made, link="file", seconds=0.1, pace="free", record=record) as run:
        deliveries = list(run)
    assert run.result.good
    assert run.unread == 0
    assert all(isinstance(one, evstim.Delivery) for one in deliveries)
    events = joined(deliveries, "events")
    assert len(events) == run.result.ledger.read_out > 1000
    assert np.array_equal(events, evstim.read_events(record))
    edges, imu = joined(deliveries, "edges"), joined(deliveries, "imu")
    assert edges.dtype == evstim.EDGE
    assert np.array_equal(edges["t"], load_edges(record)[0]["t"])
    assert edges["t"].tolist() == [10_000 * k + late for k in range(1, len(edges) // 2 + 1) for late in (0, 100)]
    assert len(edges) >= 9
    assert imu.dtype == evstim.IMU
    assert np.array_equal(imu, load_imu(record)[0])
    assert len(imu) > 50
    frames = [frame for one in deliveries for frame in one.frames]
    recorded = load_frames(record)[0]
    assert len(frames) == len(recorded) > 0
    for frame, own in zip(frames, recorded, strict=True):
        assert isinstance(frame, evstim.Frame)
        assert frame.t_us == own["t"]
        assert np.array_equal(frame.pixels, own["pixels"])


def test_a_link_delivers_what_its_host_receives():
    with evstim.run("loopback", link="loopback", seconds=0.05, pace="free") as run:
        deliveries = list(run)
    assert run.result.good
    assert sum(len(one.events) for one in deliveries) == run.result.links["loopback"].delivered > 1000
    assert [one.restarted for one in deliveries].count(True) == 1
    assert deliveries[0].restarted


@pytest.mark.system
def test_a_link_that_is_killed_ends_the_iteration():
    made = rig(evstim.LoopbackLink())
    live = evstim.run(made, link="loopback", seconds=1000.0, pace="free")
    with live as run:
        for delivery in run:
            if len(delivery.events) and run._session._links:
                os.kill(run._session._links[0].pid, signal.SIGKILL)
                break
        rest = list(run)
    assert all(isinstance(one, evstim.Delivery) for one in rest)
    assert not run.result.good
    assert "died" in run.result.links["loopback"].state


def test_links_that_cannot_be_read():
    with pytest.raises(ValueError, match="no link 'usbip'; it has loopback"):
        evstim.run("loopback", link="usbip")
    loopback = evstim.load_rig("loopback")
    again = dataclasses.replace(loopback, run=dataclasses.replace(loopback.run, restart_links=True))
    with pytest.raises(ValueError, match="restart_links"):
        evstim.run(again, link="loopback")
