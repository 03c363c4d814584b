"""The reception behind `evstim listen`: limits, summary, problems and exit code, with a fake other side."""

import dataclasses
import json

import pytest

from emulator.cli.listen import Limits, Source, listen_to
from emulator.cli.output import BAD_VERDICT, GOOD, LACKING, Failure, failing
from transports.reception import Reception

NO_LIMITS = Limits()


@pytest.fixture
def listen(capsys):
    """Return the exit code, stdout and stderr of a reception that ends as `last`, or at a limit before."""

    def run(last, limits=NO_LIMITS, *, as_json=False):
        def receive(goes_on, _):
            now = Reception()
            while goes_on(now) and now != last:
                now = dataclasses.replace(last, events=now.events + 1, seconds=now.seconds + 0.25)
                now = last if now.events >= last.events else now
            return now

        source = Source(receive, lambda it: [f", {it.faults} words", "[a line]"], "it went away")
        code = listen_to(source, limits, json=as_json)
        out, err = capsys.readouterr()
        return code, out, err

    return run


def test_the_summary_of_a_good_reception(listen):
    code, out, err = listen(Reception(events=2, edges=1, seconds=0.5, digest=0xAB))
    assert (code, err) == (GOOD, "")
    assert out == "2 events and 1 edges in 0.50 s, digest 000000ab, 0 words\n[a line]\n"


def test_the_loss_of_the_other_side_is_a_problem(listen):
    code, _, err = listen(Reception(events=1, gone=True))
    assert (code, err) == (BAD_VERDICT, "evstim: it went away\n")


def test_faults_make_a_bad_verdict(listen):
    assert listen(Reception(events=1, faults=1))[0] == BAD_VERDICT


def test_the_reception_is_the_json(listen):
    last = Reception(events=1, gone=True)
    code, out, _ = listen(last, as_json=True)
    assert json.loads(out) == {**dataclasses.asdict(last), "problems": ["it went away"]}
    assert code == BAD_VERDICT


@pytest.mark.parametrize("limits", [Limits(events=3), Limits(seconds=0.75)])
def test_a_limit_ends_the_reception(listen, limits):
    assert "3 events" in listen(Reception(events=100), limits)[1]


def test_progress_is_printed_each_second(listen):
    err = listen(Reception(events=9, seconds=2.25))[2]
    assert [line.split()[0] for line in err.splitlines()] == ["1.0", "2.0"]


def test_a_record_that_cannot_be_written_is_refused_before_the_reception(tmp_path):
    source = Source(lambda *_: pytest.fail("it received"), lambda _: [])
    with pytest.raises(Failure, match="--record") as failure:
        listen_to(source, Limits(record=tmp_path / "absent" / "a.npz"), json=False)
    assert failure.value.exit_code == LACKING


def test_errors_of_a_transport_get_the_exit_code_of_a_missing_requirement():
    with pytest.raises(Failure, match="no port") as failure, failing(LACKING, OSError):
        raise OSError("no port")
    assert failure.value.exit_code == LACKING
    with pytest.raises(ValueError, match="other"), failing(LACKING, OSError):
        raise ValueError("other")
