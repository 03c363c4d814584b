"""Row kicks against their law, played pixel by pixel: when events come within the frame, how many, and off without."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import ks_2samp, kstest

from emulator.light import LightFrame
from emulator.sensor.frames import FrameSource, frame_times
from emulator.sensor.parameters import DefectParameters, FrameParameters, JitterParameters, KickParameters
from emulator.sensor.presets import PRESETS, ReadoutParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.frames import FrameSettings

WIDTH, HEIGHT = 64, 32
THRESHOLD = 0.2
IDEAL = dataclasses.replace(
    PRESETS["ideal"], width=WIDTH, height=HEIGHT, threshold_on=THRESHOLD, threshold_off=THRESHOLD, random_start=True
)
ASKED = FrameSettings(True, True, False, 300_000, 10_000_000, 40_000_000, 0, 0, WIDTH - 1, HEIGHT - 1)
LINE_US = 35.25 * 346 / WIDTH
DELAY_US, LEAD_US = 35, (12, 28)
KICKS = KickParameters(share=0.1, signal_excess=0, spread=0)


def run(frames_s, kicks, slope_hz=0.0, leak_hz=0.0, step_ns=1_000_000, asked=ASKED, **effects):
    """Events of light that rises by `slope_hz` thresholds a second, with frames all the time.

    Rates with no simple ratio to the frames: else a pixel fires at the same phase in each, and they count as one.
    """
    sensor = Sensor(dataclasses.replace(IDEAL, leak_hz=leak_hz, leak_spread=0, **effects), 7)
    disturb = sensor.with_kicks(kicks)
    assert disturb is not None
    parameters = FrameParameters(line_us=LINE_US, kicks=kicks)
    source = FrameSource(parameters, 7, (WIDTH, HEIGHT), disturb)
    settings = tuple(int(n) for n in dataclasses.astuple(asked))

    def light(t_ns):
        return np.full((HEIGHT, WIDTH), 0.1 * np.exp(THRESHOLD * slope_hz * t_ns * 1e-9), np.float32)

    sensor.reset(LightFrame(0, light(0)))
    source.reset(LightFrame(0, light(0)))
    events = []
    for t_ns in range(step_ns, round(frames_s * 1e9) + 1, step_ns):
        source.read(LightFrame(t_ns, light(t_ns)), settings)
        events.append(sensor.expose(LightFrame(t_ns, light(t_ns))))
    events.append(sensor.finish())
    assert sensor.raised == sensor.read_out + sensor.lost_at_readout
    assert sensor.pending == 0
    return np.concatenate(events)


def read_times_ns(asked=ASKED):
    """Kick of the reset and of the signal read of each line, (2, lines), in the first frame."""
    times = frame_times(0, asked, LINE_US)
    leads = np.array(LEAD_US)[:, None] * 1000
    return np.maximum(np.stack([times.reset_ns, times.signal_ns]) - leads, 0)


def since_own_read_us(events, line="y", asked=ASKED):
    """Time since the last kick of the event's own line, rounded up."""
    starts = read_times_ns(asked)[:, events[line]]
    return ((whole_us(events["t"]) - starts) % 40_000_000).min(axis=0) * 1e-3


def whole_us(t_us):
    """The last nanosecond of the microsecond that an event tells."""
    return t_us.astype(np.int64) * 1000 + 999


def after_start(events):
    """Without the first frame, at whose start some pixels are close to their thresholds."""
    return events[events["t"] >= 40_000]


def played(rate_hz, seconds, seed, strength=(0.1, 0.1)):
    """The law, one pixel after another: times (ns) and lines of all events of levels that rise at `rate_hz`."""
    random = np.random.default_rng(seed)
    found = []
    for line in range(HEIGHT):
        reads = [(f * 40_000_000 + read_times_ns()[k, line], k) for f in range(int(seconds / 0.04) + 1) for k in (0, 1)]
        for level in random.random(WIDTH):
            found += [(t, line) for t in _pixel(level, rate_hz * 1e-9, sorted(reads), strength, random)]
    t_ns, lines = np.array([f for f in found if f[0] < seconds * 1e9]).T
    return whole_us(t_ns // 1000), lines.astype(int)


def _pixel(level, rate, reads, strength, random):
    now = 0
    for read, kind in reads:
        while level + rate * (read - now) >= 1:
            now += (1 - level) / rate
            level = 0.0
            yield now
        level, now = level + rate * (read - now), read
        if level + strength[kind] >= 1:
            yield now + random.random() * DELAY_US * 1000 * (1 - level) / strength[kind]
            level -= 1


def in_frame(t_ns, line):
    """Time since the reset read of the own line, in the frame."""
    return (t_ns - read_times_ns()[0][line]) % 40_000_000


@pytest.mark.system
@pytest.mark.parametrize("rate_hz", [5.37, 47.3])
def test_events_of_rising_light_come_in_the_frame_as_the_law_has_it(rate_hz):
    seconds = 4.0 if rate_hz < 10 else 0.8
    events = run(seconds, KICKS, slope_hz=rate_hz)
    expected = played(rate_hz, seconds, 3)
    assert len(events) == pytest.approx(len(expected[0]), rel=0.02)
    assert ks_2samp(in_frame(whole_us(events["t"]), events["y"]), in_frame(*expected)).pvalue > 0.01
    without = run(seconds, dataclasses.replace(KICKS, share=0), slope_hz=rate_hz)
    assert ks_2samp(in_frame(whole_us(without["t"]), without["y"]), in_frame(*expected)).pvalue < 1e-6


def test_a_kick_is_worth_its_share_of_a_threshold_and_is_repaid():
    events = run(0.8, KICKS, slope_hz=47.3)
    since = since_own_read_us(events)
    assert np.count_nonzero(since < 40) / (40 * WIDTH * HEIGHT) == pytest.approx(0.1, rel=0.03)  # 20 frames of 2 reads
    assert not np.count_nonzero((since > 37) & (since < 1900))  # 2 ms of rising were taken ahead
    assert len(events) == pytest.approx(0.8 * 47.3 * WIDTH * HEIGHT, rel=0.01)


def test_events_of_still_pixels_come_evenly_in_the_time_of_a_kick():
    events = run(8.0, KICKS, leak_hz=0.05)
    assert len(events) == pytest.approx(8 * 0.05 * WIDTH * HEIGHT, rel=0.1)
    assert events["on"].all()
    since = since_own_read_us(events)
    assert since.max() <= DELAY_US + 1
    assert kstest(since - 0.5, "uniform", args=(0, DELAY_US)).pvalue > 0.001


def test_delays_of_moving_pixels_follow_the_share_of_the_kick_that_they_need():
    """Any share from 0 to 1 has the same chance: the delay's distribution is u (1 - ln u), u = t / 35 us."""
    events = run(0.8, KICKS, slope_hz=47.3)
    since = since_own_read_us(events)
    u = np.linspace(0, 1, 1001)[1:]
    kicked = since[since <= DELAY_US + 1] - 0.5
    assert kstest(kicked, lambda t: np.interp(t / DELAY_US, u, u * (1 - np.log(u)))).statistic < 0.03
    assert len(kicked) > 5000


@pytest.mark.parametrize("random_start", [True, False])
def test_the_first_frame_has_no_more_events_than_later_ones(random_start):
    """Levels at random would put one still pixel in ten within a kick of its threshold."""
    events = run(0.4, KickParameters(), leak_hz=0.5, random_start=random_start)
    frames = np.bincount((events["t"] // 40_000).astype(int), minlength=10)
    assert frames[0] <= frames[1:].max() if random_start else not len(events)
    assert random_start == (len(events) > 0.3 * 0.4 * 0.5 * WIDTH * HEIGHT)


@pytest.mark.system
def test_in_stillness_the_stronger_read_takes_most_events():
    """302 of 376 at signal reads in the recording."""
    events = after_start(run(40.0, KickParameters(), leak_hz=0.02, step_ns=20_000_000))
    signal = (whole_us(events["t"]) - read_times_ns()[1][events["y"]]) % 40_000_000 < 400_000
    assert len(events) > 1000
    assert 0.70 < signal.mean() < 0.88


def test_lines_are_columns_in_an_upright_chip():
    asked = dataclasses.replace(ASKED, by_column=True)
    events = after_start(run(1.0, KICKS, leak_hz=1.0, asked=asked))
    assert len(events) > 1000
    assert since_own_read_us(events, "x", asked).max() < 400


def test_kicks_do_not_depend_on_the_step():
    runs = [run(0.2, KICKS, slope_hz=20.0, step_ns=step) for step in (500_000, 2_000_000)]
    common = np.intersect1d(*[one.view("V13") if one.itemsize == 13 else one for one in runs])
    assert len(common) > 0.99 * len(runs[0])


def test_without_frames_nothing_is_disturbed():
    off = run(0.3, KICKS, slope_hz=20.0, asked=dataclasses.replace(ASKED, run=False))
    never = run(0.3, dataclasses.replace(KICKS, share=0), slope_hz=20.0, asked=dataclasses.replace(ASKED, run=False))
    assert off.tolist() == never.tolist()


DELAYED = {
    "jitter": {"jitter": JitterParameters(latency_us=200.0, deviation_us=100.0)},
    "long jitter": {"jitter": JitterParameters(latency_us=20_000.0, deviation_us=10_000.0)},
    "jitter, read-out": {
        "jitter": JitterParameters(latency_us=200.0, deviation_us=100.0),
        "readout": ReadoutParameters(event_ns=80.0, row_ns=80),
    },
    "dead pixels": {"defects": DefectParameters(dead_share=0.3)},
}


@pytest.mark.parametrize("effects", DELAYED)
def test_a_run_of_any_length_ends_with_all_its_events_in_time_order(effects):
    """Late kicks and delayed events of the last step: a longer run has the same events, and those that follow."""
    whole = run(0.060, KickParameters(), 40.0, **DELAYED[effects])
    assert (np.diff(whole["t"].astype(np.int64)) >= 0).all()
    known = {event.tobytes() for event in whole}
    for length_ms in range(12, 36):
        events = run(length_ms * 1e-3, KickParameters(), 40.0, **DELAYED[effects])
        assert (np.diff(events["t"].astype(np.int64)) >= 0).all()
        left = events[events["t"] < length_ms * 1000]
        assert np.array_equal(left, whole[: len(left)])
        assert (whole["t"][len(left) :] >= length_ms * 1000).all()
        assert len({event.tobytes() for event in events[len(left) :]} & known) >= 0.9 * (len(events) - len(left))


def test_dead_pixels_are_not_kicked():
    dead = {(x, y) for x in range(0, WIDTH, 2) for y in range(0, HEIGHT, 3)}
    events = run(0.0153, KickParameters(share=0.9), 40.0, defects=DefectParameters(dead_pixels=tuple(dead)))
    assert not dead & set(zip(events["x"].tolist(), events["y"].tolist(), strict=True))
