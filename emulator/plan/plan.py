"""The plan of a run, made before it starts: its steps, and each effect kept or dropped with the bound that decided.

A rig without a tolerance fixes everything: steps of its own length, no effect dropped. The plan still has the error
of the step and the cost of each effect. A rig with a tolerance gets controlled steps (see `step_control`), and effects
that change less than the tolerance are dropped (see `decide`).

Decisions about effects use these bounds. A is the scene's contrast rate, C its bend (see `scene_probe`), theta the
threshold, T the run's length, N = A T / theta the events that an active pixel raises, n the events of one monotone run,
eps the tolerated timestamp error, delta the tolerated share of wrong events, dim the share of dark current in the
darkest active light.

    effect              cost of dropping it                                dropped when
    low-pass            every stamp early by tau                           the longest tau < eps
    bandwidth           lags differ by those of darkest and brightest      that < eps
    large signals       stamps early by (1 + ln range) / (2 pi f_max)      that < eps; off unless selected
    source follower     every stamp early by 1/lambda2                     1/lambda2 < eps
    high-pass           a run of z time constants loses 1 - (1 - e^-z)/z   that < delta
    leak                R T events a pixel; stamps drift by R theta T/A    R T < delta N, and the drift < eps
    its spread, jitter  the same, of the rate's deviation                  the same
    parasitic           the same, R proportional to light                  the same
    mismatch            stamps off by n sigma theta / A                    that < eps
    refractory          t_ref A/theta of the events; stamps by n t_ref     that < delta, and n t_ref < eps
    noise               R events a second; stamps off by rms / A           R < delta A/theta, and rms / A < eps
    jitter              stamps early by the latency                        latency + 2 deviations < eps
    comparator          stamps early by its delay at A, events by delay A/theta    that < eps, and < delta
    reset offset        contrasts by o / theta; stamps by n o / A          that < delta, and < eps
    reset noise         stamps off by 2 sqrt(n) s / A                      that < eps
    acknowledge         as the refractory period, of the mean wait         the same
    veiling glare       contrasts in dim light smaller by its share there  never: it is a floor of the light
    dark current        contrasts larger by dim                            never: it is the floor of the logarithm
    temperature         its changes of leak and dark current               as these
    efficiencies, PRNU  contrasts by change dim, stamps by change tau      that < delta, and < eps
    DCNU                the same, of dark current                          the same
    shot noise          stamps off by s / A, events where s is large       these < eps, < delta
    hot pixels          their events                                       less than delta of the stream
    dead pixels         their events                                       less than delta of the pixels
    radiation, dose     its events                                         less than delta of the stream

Noise without a low-pass fired 70 times as often, without leak a quarter less often (EVK4): where noise is kept, so is
all on which its rate depends.
Mismatch and leak soon change the sequences of events: they are dropped only where the run tolerates that. Effects that
the rig has switched off are not modelled and have no bound.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from emulator.plan.costs import SHAPES_NOISE, Decision, Tolerance, chip_costs, lens_costs, pixel_costs
from emulator.plan.scene_probe import Probe
from emulator.plan.step_control import Limits
from emulator.rig.kinds import SCENES
from emulator.rig.loading import Rig
from emulator.sensor.presets import SensorParameters
from transports.link.kind import CameraFacts, InstrumentLink

__all__ = ["Decision", "Plan", "Steps", "Tolerance", "decide", "limits", "line_loads", "make_plan", "without"]


def decide(sensor: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision]:
    """Return a decision for each effect that `sensor` has switched on."""
    costs = [*pixel_costs(sensor, scene, tolerance), *chip_costs(sensor, scene, tolerance)]
    decisions = [_judge(cost, tolerance) for cost in costs]
    if not any(decision.effect == "noise" and decision.kept for decision in decisions):
        return decisions
    return [_kept_with_noise(decision) for decision in decisions]


def without(sensor: SensorParameters, decisions: list[Decision]) -> SensorParameters:
    """Return `sensor` without the effects that were dropped."""
    for decision in decisions:
        if not decision.kept:
            for name, value in decision.changes.items():
                table = isinstance(value, dict)
                sensor = dataclasses.replace(
                    sensor, **{name: dataclasses.replace(getattr(sensor, name), **value) if table else value}
                )
    return sensor


def _judge(cost: Decision, tolerance: Tolerance) -> Decision:
    if not cost.choice:
        return cost
    too_late = cost.cost_us is not None and not cost.cost_us < tolerance.eps_us
    too_many = cost.cost_share is not None and not cost.cost_share < tolerance.wrong_share
    return dataclasses.replace(cost, kept=too_late or too_many)


def _kept_with_noise(decision: Decision) -> Decision:
    if decision.kept or decision.effect not in SHAPES_NOISE:
        return decision
    bound = f"{decision.bound}; kept with the noise, whose rate depends on it"
    return dataclasses.replace(decision, bound=bound, kept=True)


_LINE, _HERMITE = 2, 4  # orders of the two interpolations
_PINNED_TOLERANCE_US = 100.0  # tolerance for the cost of effects where the rig gives none


@dataclass(frozen=True)
class Steps:
    """Expected steps of a run.

    Attributes
    ----------
    controlled : whether step control sets them; else all are `step_us` long.
    step_us : expected length.
    error_us : expected 95th percentile of timestamp errors of the interpolation between two frames.
    bound : reason for the length.
    line_step_us : step of the same error with a straight line in log light.
    """

    controlled: bool
    step_us: float
    error_us: float
    bound: str
    line_step_us: float


@dataclass(frozen=True)
class Plan:
    """The plan of a run."""

    rig: Rig
    probe: Probe
    tolerance: Tolerance
    steps: Steps
    decisions: list[Decision]

    @property
    def pinned(self) -> bool:
        """True when the rig gives no tolerance, so that nothing is dropped."""
        return self.rig.run.tolerance_us == 0

    @property
    def sensor(self) -> SensorParameters:
        """The sensor as it will run."""
        sensor = self.rig.camera.sensor
        return sensor if self.pinned else without(sensor, self.decisions)


@dataclass(frozen=True)
class LineLoad:
    """Load of the line of a link: events a second that it carries, and is expected to get, about, and the share.

    Both of the last are None where no scene was probed.
    """

    link: str
    carries_hz: float
    expected_hz: float | None = None
    share: float | None = None

    @property
    def line(self) -> str:
        """The load as a sentence, numbers with two digits."""
        text = f"link {self.link}: its line carries about {float(f'{self.carries_hz:.2g}'):.0f} events/s"
        if self.expected_hz is None or self.share is None:
            return f"{text}; `evstim plan` gives the share of the scene's"
        part = "all" if self.share == 1 else f"{100 * self.share:.2g} %"
        return f"{text}, {part} of the {float(f'{self.expected_hz:.2g}'):.0f} that the scene is expected to give"


def line_loads(rig: Rig, events_per_s: float | None = None) -> list[LineLoad]:
    """Return the loads of the lines that have a limit; `events_per_s` of the camera, None: not known."""
    size, loads = rig.camera.size, []
    camera = CameraFacts(rig.camera.model, size, speed=rig.camera.speed)
    for link in rig.links:
        carries_hz, expected_hz = link.carries_hz(camera), events_per_s
        if expected_hz and isinstance(link, InstrumentLink):
            expected_hz *= link.instrument.selected_share(size)
        if carries_hz < math.inf:
            share = None if expected_hz is None else min(1.0, carries_hz / max(expected_hz, 1e-9))
            loads.append(LineLoad(link.name, carries_hz, expected_hz, share))
    return loads


def make_plan(rig: Rig, probe: Probe) -> Plan:
    """Return the plan of a rig for a probed scene."""
    run = rig.run
    duration_s = run.seconds or 10.0
    tolerance = Tolerance(run.tolerance_us or _PINNED_TOLERANCE_US, run.tolerated_wrong_share, duration_s)
    steps = _steps(rig, probe)
    sensor = rig.camera.sensor
    seen = [] if SCENES[rig.scene.kind].lens == "none" else lens_costs(rig.camera.lens, sensor, probe)
    decisions = [*decide(sensor, probe, tolerance), *seen]
    return Plan(rig, probe, tolerance, steps, decisions)


def limits(rig: Rig) -> Limits:
    """Return the limits of controlled steps of this rig."""
    return Limits(rig.run.tolerance_us, wrong_share=rig.run.tolerated_wrong_share)


def _steps(rig: Rig, probe: Probe) -> Steps:
    tolerance_us, order = rig.run.tolerance_us, _HERMITE if rig.run.method == "hermite" else _LINE
    error_us = probe.hermite_error_us if order == _HERMITE else probe.line_error_us
    if not tolerance_us:
        step_us = float(rig.run.step_us)
        pinned_us = _error(step_us, error_us, probe, order)
        line_us = _step_for(max(pinned_us, 0.01), probe.line_error_us, probe, _LINE)
        return Steps(False, step_us, pinned_us, "pinned by the rig", line_us)
    allowed = limits(rig)
    slips = probe.hermite_slips if order == _HERMITE else probe.line_slips
    by_error_us = _step_for(tolerance_us, error_us, probe, order)
    by_slips_us = _step_for(allowed.slips, slips, probe, order)
    shortest_us, longest_us = allowed.shortest_ns / 1000, allowed.longest_ns / 1000
    needed_us = min(by_error_us, by_slips_us)
    bound = "the tolerance" if by_error_us <= by_slips_us else "the wrong events, where light turns"
    if needed_us >= longest_us:
        bound = "the longest step"
    if needed_us < shortest_us:
        bound = f"the shortest step: the tolerance would need {needed_us:.2g} us, and cannot be kept"
    step_us = min(max(needed_us, shortest_us), longest_us)
    line_us = _step_for(tolerance_us, probe.line_error_us, probe, _LINE)
    return Steps(True, step_us, _error(step_us, error_us, probe, order), bound, line_us)


def _error(step_us: float, probed: float, probe: Probe, order: int) -> float:
    """Return the error at another step than the probe's, where it is `probed`."""
    return float(probed * (step_us * 1e-6 / probe.step_s) ** order)


def _step_for(error: float, probed: float, probe: Probe, order: int) -> float:
    """Return the step, us, that makes this error where the probe's makes `probed`; at most a second."""
    return min(1e6, probe.step_s * 1e6 * float((error / probed) ** (1 / order))) if probed > 0 else 1e6
