"""Scores of streams made by hand, whose answers are known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EVENT
from laboratory.accuracy.scores import Stream, compare, compare_samples

TRUTH = Stream.of([10, 20, 30, 15], [0, 0, 0, 1], [True, True, False, True], 3)


def test_a_stream_sorts_by_pixel_and_time_and_reads_events():
    events = np.array([(5, 1, 0, True), (6, 0, 0, False), (9, 1, 0, False)], EVENT)
    stream = Stream.from_events(events, width=2, height=1)
    assert stream.t_us.tolist() == [6, 5, 9]
    assert stream.pixel.tolist() == [0, 1, 1]
    assert stream.on.tolist() == [False, True, False]
    assert stream.counts.tolist() == [1, 2]


@pytest.mark.parametrize(
    ("t", "pixel", "on"), [([1, 2], [0], [True]), ([math.nan], [0], [True]), ([1], [3], [True]), ([1], [-1], [True])]
)
def test_a_stream_refuses_what_is_no_stream(t, pixel, on):
    with pytest.raises(ValueError, match="must"):
        Stream.of(t, pixel, on, 3)


def test_the_truth_agrees_with_itself():
    score = compare(TRUTH, TRUTH)
    assert (score.right, score.t50_us, score.t95_us, score.count, score.wrong_events) == (1, 0, 0, 1, 0)
    assert (score.earth_mover_us, score.same_time) == (0, 0)


def test_late_events_are_right_and_late():
    late = Stream.of([14, 22, 31, 15], [0, 0, 0, 1], TRUTH.on, 3)
    score = compare(late, TRUTH)
    assert (score.right, score.wrong_events) == (1, 0)
    assert score.t50_us == pytest.approx(1.5)
    assert score.t95_us == pytest.approx(np.quantile([4, 2, 1, 0], 0.95))
    # ON of pixel 0 moves by 4 and 2, its OFF by 1, pixel 1 by nothing
    assert score.earth_mover_us == pytest.approx((2 * 3 + 1 + 0) / 4)


def test_a_silent_sensor():
    score = compare(Stream.of([], [], [], 3), TRUTH)
    assert (score.right, score.count, score.wrong_events) == (0, 0, 1)
    assert math.isnan(score.t50_us)
    assert math.isnan(score.earth_mover_us)


@pytest.mark.parametrize(
    ("on", "wrong", "right"),
    [
        ([True, True, False], 0, 1),
        ([True, False], 1, 0.5),  # one ON missed
        ([True, True, False, True], 1, 0.5),  # one invented
        ([False, True, False], 2, 0.5),  # one of the other sign: struck out and put in
        ([False, False, False], 4, 0.5),
    ],
)
def test_wrong_events_are_those_to_strike_out_and_to_put_in(on, wrong, right):
    t, pixel = [*range(len(on)), 15], [0] * len(on) + [1]
    score = compare(Stream.of(t, pixel, [*on, True], 3), TRUTH)
    assert score.wrong_events == pytest.approx(wrong / 4)
    assert score.right == right


def test_an_event_at_a_silent_pixel_makes_it_active_and_wrong():
    score = compare(Stream.of([10, 20, 30, 15, 1], [0, 0, 0, 1, 2], [True, True, False, True, True], 3), TRUTH)
    assert score.right == pytest.approx(2 / 3)
    assert score.wrong_events == pytest.approx(1 / 4)


def test_the_earth_mover_takes_each_train_as_mass_one():
    two, one = Stream.of([0, 10], [0, 0], [True, True], 1), Stream.of([4], [0], [True], 1)
    assert compare(two, one).earth_mover_us == pytest.approx(0.5 * 4 + 0.5 * 6)


trains = st.lists(st.tuples(st.integers(0, 50), st.integers(0, 3), st.booleans()), max_size=40)


def stream_of(train):
    t, pixel, on = zip(*train, strict=True) if train else ((), (), ())
    return Stream.of(t, pixel, on, 4)


@given(trains, trains)
def test_scores_stay_within_their_bounds(a, b):
    score = compare(stream_of(a), stream_of(b))
    if a or b:
        assert 0 <= score.right <= 1
    if b:
        assert abs(len(a) - len(b)) / len(b) <= score.wrong_events <= (len(a) + len(b)) / len(b)


def test_words_and_intervals_do_not_go_from_pixel_to_pixel():
    stream = Stream.of([0, 1, 3, 10, 14], [0, 0, 0, 1, 1], [True, True, False, False, True], 3)
    assert stream.intervals_us().tolist() == [1, 2, 4]
    np.testing.assert_allclose(stream.words(2), [0, 1 / 3, 1 / 3, 1 / 3])  # OFF OFF, OFF ON, ON OFF, ON ON
    np.testing.assert_allclose(stream.words(3), np.eye(8)[0b110])
    assert np.isnan(stream.words(4)).all()
    assert stream.where(stream.on).intervals_us().tolist() == [1]


def poisson(rate_hz, seed, alternate):
    """100 s of 200 pixels."""
    random = np.random.default_rng(seed)
    counts = random.poisson(100 * rate_hz, 200)
    t_us, pixel = random.uniform(0, 1e8, counts.sum()), np.repeat(np.arange(200), counts)
    order = np.lexsort((t_us, pixel))
    on = np.arange(t_us.size) % 2 == 0 if alternate else random.random(t_us.size) < 0.5
    return Stream.of(t_us[order], pixel[order], on, 200)


def test_samples_of_one_distribution_are_alike_and_others_differ_by_what_differs():
    """The bounds are five standard deviations of 40 000 events."""
    truth = poisson(2.0, 1, alternate=False)
    same = compare_samples(poisson(2.0, 2, alternate=False), truth)
    assert same.right > 1 - 16 * 5 * math.sqrt(2 / 16 / 40_000) / 2
    assert same.wrong_events < 5 * math.sqrt(4 / 40_000)
    assert same.earth_mover_us < 0.05 * 5e5
    more = compare_samples(poisson(2.4, 3, alternate=False), truth)
    assert more.wrong_events == pytest.approx(0.2, abs=0.05)
    assert more.earth_mover_us == pytest.approx(5e5 - 5e5 / 1.2, rel=0.1)
    ordered = compare_samples(poisson(2.0, 4, alternate=True), truth)
    assert ordered.right == pytest.approx(1 / 8, abs=0.02)  # two of 16 words
    assert ordered.wrong_events < 0.1
    with pytest.raises(ValueError, match="same pixels"):
        compare_samples(truth, TRUTH)
    silent = compare_samples(Stream.of([], [], [], 200), truth)
    assert (silent.wrong_events, silent.count) == (1, 0)
    assert math.isnan(silent.t95_us)
