"""The ledger that the page shows adds up at any moment."""

from hypothesis import given
from hypothesis import strategies as st

from emulator.live_page.page import ledger_table
from emulator.run.outcome import Rates, RunStatus
from emulator.run.pacing import Lateness
from firmware_protocol.device.fates import Fates
from transports.link.report import LinkReport

_count = st.integers(0, 10**12)


def _status(sim_s=1.0, wall_s=1.0, read_out=0, frames=5, lateness=None, **more):
    return RunStatus(sim_s, wall_s, frames, read_out, lateness or Lateness(), **{"links": {}, **more})


@given(_count, _count, _count, _count, st.lists(st.tuples(_count, _count), max_size=3))
def test_parts_add_up(pending, pixel, readout, read_out, links):
    reports = {f"l{k}": LinkReport("open", delivered=d, dropped=x) for k, (d, x) in enumerate(links)}
    status = _status(
        read_out=read_out,
        links=reports,
        raised=pending + pixel + readout + read_out,
        lost_in_pixel=pixel,
        lost_at_readout=readout,
    )
    table = ledger_table(status)
    assert table["parts"]["pending"] == pending
    for whole in (table, *table["links"].values()):
        assert sum(whole["parts"].values()) == whole["whole"]


def test_an_event_with_two_fates_shows_as_a_negative_part():
    table = ledger_table(_status(read_out=5, raised=5, links={"a": LinkReport("open", delivered=6)}))
    assert table["links"]["a"]["parts"]["on_the_way"] == -1


def test_events_before_a_host_reads_are_apart_from_those_that_the_camera_drops():
    camera = Fates(offered=100, not_running=70, dropped_fifo=20, delivered=10)
    parts = ledger_table(
        _status(read_out=100, raised=100, links={"a": LinkReport("open", delivered=10, camera=camera)})
    )["links"]["a"]["parts"]
    assert parts == {"delivered": 10, "on_the_way": 0, "no_host": 70, "dropped_in_device": 20, "dropped": 0}


def test_rates_are_those_of_the_last_second():
    rates = Rates()
    assert rates.renew(_status(0.0, 0.0))["events_per_s"] == 0
    assert rates.renew(_status(0.5, 1.0, 1000)) == {
        "events_per_s": 2000.0, "real_time_factor": 0.5, "steps": 0, "steps_late": 0,
    }  # fmt: skip


def test_steps_that_were_late_before_the_last_second_are_not_late_now():
    rates, late = Rates(), Lateness()  # one object for the whole run, as in a session
    for k in range(30):
        if k < 10:
            late.add(1_000_000, 1)
        now = rates.renew(_status(0.1 * k, 0.1 * k, frames=2 * k, lateness=late))
        if k == 9:
            assert (now["steps"], now["steps_late"]) == (18, 9)
    assert (now["steps"], now["steps_late"], late.frames_late) == (18, 0, 10)
