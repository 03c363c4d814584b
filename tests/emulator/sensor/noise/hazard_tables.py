"""Tables of first-passage hazards of the temporal noise, which the solver of crossings looks up.

Given what the noise was at a pixel's last reset, it is a stationary process z of unit deviation, and a threshold is a
boundary c that moves at the speed nu = -dc/dq, positive towards the noise. The hazard H is the rate of first passages
of the paths that have not passed yet. phi and Phi are the normal density and distribution.

One pole: z is an Ornstein-Uhlenbeck process, its time constant is the unit of time q. With p = phi(z) g, y = c - z:

    g_q = g_yy + (c + nu - y) g_y,    g(0) = 0,    H = phi(c) g_y(0) / int p

Two poles a1, a2: z' = v, v' = -z - b v + sqrt(2 b) (white noise), v of unit deviation too. The unit of time is
1 / sqrt(a1 a2), b = (a1 + a2) / sqrt(a1 a2). With p = phi(z) phi(v) g, u = v + nu:

    g_q = u g_y + (z - b v) g_v + b g_vv,    g(0, u < 0) = 0,    H = phi(c) int_0^inf u phi(v) g(0) dv / int p

Without earlier passages g is 1, and H is Rice's rate, phi(c) (phi(nu) + nu Phi(nu)). The boundary comes at constant
speed from 9 deviations; one that recedes was still for a long time before, at c = -1, or at c itself if that is lower.

    one        (209, 65)      H / ((1 + |nu|) phi(max(c, 0))) of one pole: c from -4 in steps of 1/16, and
                              rho = nu / (1 + |nu|) from -1 in steps of 1/32; H = nu phi(c) / Phi(c) at rho = 1
    one_start  (65,)          r(c), c from 0 in steps of 1/8: nu = c e^(-2 s/tau) falls after a reset, while `one` takes
                              it as constant, so H is multiplied by 1 + r e^(-s/tau); the first instant is then
                              Brownian motion's, H = 2 c phi(c) / erf(c / sqrt 2)
    one_pair   (53, 53)       F(a, b), a and b from -1/2 in steps of 1/8: flux through a still threshold a above the
                              mean while the other one lies b below it, over the flux without the other one
    two        (7, 105, 65)   as `one`, for two poles: 1/b = 1/8, 3/16 .. 1/2; c from -4 in steps of 1/8; rho
    two_speed  (7, 105, 65)   mean of the speed u at a passage, over that of Rice's density, u phi(u - nu)
    two_pair   (7, 25, 25)    as `one_pair`, in steps of 1/4
    exit       (57, 65)       quantiles of Rice's density: nu from -6 in steps of 1/4; j/64, the last one 1 - 1/600

One pole is solved by BDF2. For two poles a step of time is split: v mixes, by an L-stable scheme of second order (R.
Alexander, SIAM J. Numer. Anal. 14, 1977), then y moves along characteristics, by cubic interpolation. A flux is the
mean of those before and after the mixing. Near the boundary g is like y^(1/6) at u = 0, so both grids are finest there.
With steps of a third, hazards of two poles differ by 0.2 % at most (where they are not negligible), of one by 1e-4.

`python -m tests.emulator.sensor.noise.hazard_tables` writes the file, in some six minutes.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.hazard import TABLES
from emulator.sensor.numerics.compiled import kernel, vector_kernel

HAZARDS = TABLES

RHO = np.arange(-32, 33) / 32
SPEEDS = RHO[1:-1] / (1 - abs(RHO[1:-1]))
C_ONE, C_TWO = np.arange(209) / 16 - 4, np.arange(105) / 8 - 4
C_START = np.arange(65) / 8
PAIR_ONE, PAIR_TWO = np.arange(53) / 8 - 0.5, np.arange(25) / 4 - 0.5
INVERSE_B = np.arange(2, 9) / 16
EXIT_SPEEDS = np.arange(57) / 4 - 6

_RECEDES_FROM = -1.0
_LEAST_GAP = 0.75  # deviations between two thresholds; closer ones take the value of a pair that is farther apart
_SLOWEST = -5.0  # speed below which the mean speed at a passage is that of the next one
_DEPTH, _FASTEST, _FINE_TO = 15.0, 5.6, 5.0  # ends of the grids in y and v; v up to which that is finest at u = 0

_CELLS_ONE, _SUBSTEPS_ONE, _STEP_ONE, _CELLS_PAIR_ONE = 1000, 6, 0.03, 1200
_LONG, _REPEATS = 30.0, 40  # a step of time of one pole, and how many of them lead to the state of rest

_STEP, _FIRST, _LAST, _CELLS, _CELLS_PAIR = 0.03, 1e-3, 0.15, 160, 50  # time step times b; distances
_FINEST, _COARSEST, _COARSER = 0.03, 0.12, 2.0  # slopes; steps of slope and time are coarser between two thresholds
_SETTLED = 3e-5
_GAMMA = 1 - math.sqrt(0.5)

_Floats = npt.NDArray[np.float64]
_LOG = logging.getLogger(__name__)


def density(x: npt.ArrayLike) -> Any:
    """Return phi(x)."""
    return np.exp(-np.square(x) / 2) / math.sqrt(2 * math.pi)


def rice(nu: npt.ArrayLike) -> tuple[_Floats, _Floats]:
    """Return Rice's rate over phi(c), and the mean of the speed u at its passages."""
    from scipy.special import ndtr

    flat, rate = density(nu), density(nu) + nu * ndtr(nu)
    return rate, ((1 + np.square(nu)) * ndtr(nu) + nu * flat) / rate


def _stretched(first: float, last: float, length: float, cells: int) -> _Floats:
    """Return nodes from 0 to a length; the cells grow from `first` geometrically and level off towards `last`."""

    def nodes(growth: float) -> _Floats:
        return np.concatenate([[0.0], np.cumsum(1 / (np.exp(-growth * np.arange(cells)) / first + 1 / last))])

    low, high = 0.0, 3.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if nodes(middle)[-1] > length else (middle, high)
    return np.asarray(nodes(low) * (length / nodes(low)[-1]))


def _trapezoid(x: _Floats) -> _Floats:
    """Return the weights of the trapezoidal rule."""
    return np.convolve(np.diff(x), [0.5, 0.5])


# One pole


@kernel
def _diffuse(g: _Floats, right: _Floats, y: _Floats, drift: float, h: float, wall: bool) -> None:
    """Solve (1 - h L) g = right, L g = g_yy + (drift - y) g_y, g = 0 at y = 0; at the end g = 0 (a wall) or flat.

    `right` is lost.
    """
    last = y.size - 1
    g[0], right[0] = 0.0, 0.0  # from here on `right` holds the shares of the elimination
    for i in range(1, last):
        below, above = y[i] - y[i - 1], y[i + 1] - y[i]
        to_below = h * (2 - (drift - y[i]) * above) / (below * (below + above))
        to_above = h * (2 + (drift - y[i]) * below) / (above * (below + above))
        pivot = 1 + to_below + to_above - to_below * right[i - 1]
        g[i] = (right[i] + to_below * g[i - 1]) / pivot
        right[i] = to_above / pivot
    g[last] = 0.0 if wall else g[last - 1] / (1 - right[last - 1])
    for i in range(last - 1, 0, -1):
        g[i] += right[i] * g[i + 1]


def _flux_one(g: _Floats, y: _Floats, c: float) -> tuple[float, float]:
    """Return H / phi(c) of a state of one pole, and its probability."""
    middle, ends = (g[1:] + g[:-1]) / 2 * density(c - (y[1:] + y[:-1]) / 2), g * density(c - y)
    mass = float(np.diff(y) @ (ends[1:] + ends[:-1] + 4 * middle) / 6)
    slope = (g[1] * y[2] / y[1] - g[2] * y[1] / y[2]) / (y[2] - y[1])
    return float(slope) / mass, mass


def _rest_one(y: _Floats, c: float, drift: float, wall: bool = False) -> _Floats:
    """Return the state of one pole after a long time at one place of the boundary, by inverse iteration."""
    g = np.minimum(y, 1)
    for _ in range(_REPEATS):
        _diffuse(g, g / _flux_one(g, y, c)[1], y, drift, _LONG, wall)
    return g / _flux_one(g, y, c)[1]


def one_pole(nu: float) -> _Floats:
    """Return H / phi(c) of one pole at the nodes of c, for a speed of the boundary."""
    y = _stretched(min(1e-3, 0.02 / (9 + abs(nu))), 0.05, _DEPTH, _CELLS_ONE)
    begin = 1 + int(np.flatnonzero(C_ONE == _RECEDES_FROM)[0]) if nu < 0 else C_ONE.size if nu == 0 else 1
    path, found = C_ONE if nu < 0 else C_ONE[::-1], []
    for c in path[:begin]:
        g = _rest_one(y, c, c + max(nu, 0.0))
        found.append(_flux_one(g, y, c)[0])
    spacing, older, new = 1 / 16, None, np.empty(y.size)
    substeps = max(_SUBSTEPS_ONE, math.ceil(spacing / _STEP_ONE / max(abs(nu), SPEEDS[32])))
    for node in path[begin:]:
        for c in node + math.copysign(spacing / substeps, nu) * np.arange(substeps)[::-1]:
            right, h = (g.copy(), 1.0) if older is None else ((4 * g - older) / 3, 2 / 3)
            _diffuse(new, right, y, c + nu, h * spacing / substeps / abs(nu), False)
            mass = _flux_one(new, y, c)[1]
            older, g = g / mass, new / mass
        found.append(_flux_one(g, y, node)[0])
    return np.array(found if nu < 0 else found[::-1])


def one_pole_pair(above: float, below: float) -> tuple[float, float]:
    """Return the hazards of one pole at two still thresholds, so far above and below the mean."""
    y = np.linspace(0, above + below, _CELLS_PAIR_ONE + 1)
    g = _rest_one(y, above, above, wall=True)
    return float(density(above)) * _flux_one(g, y, above)[0], float(density(below)) * _flux_one(g[::-1], y, below)[0]


def one_start(one: _Floats) -> _Floats:
    """Return r(c), from the table of one pole as it is interpolated."""
    from scipy.special import erf

    tabled = [np.interp(c / (1 + c), RHO, one[np.searchsorted(C_ONE, c)]) * (1 + c) for c in C_START]
    first = np.append(math.sqrt(2 * math.pi), 2 * C_START[1:] / erf(C_START[1:] / math.sqrt(2)))
    return np.asarray(first / tabled - 1)


# Two poles


class Plane(NamedTuple):
    """Grid of the distance y behind a boundary and of the slope v, and what one step of time needs on it.

    Attributes
    ----------
    u : v + nu, (slopes,).
    dq : step of time.
    mixing : (4, slopes); two rates to the neighbours below and above, and their parts that are multiplied by z.
    source, share : (slopes, distances) and (4, slopes, distances); first of the four nodes from which the next value
        of a node is interpolated, and their weights.
    v_weight, y_weight : quadrature, with phi(v).
    mixed, work : (slopes, distances); for intermediate results.
    """

    y: _Floats
    v: _Floats
    u: _Floats
    dq: float
    mixing: _Floats
    source: npt.NDArray[np.int64]
    share: _Floats
    v_weight: _Floats
    y_weight: _Floats
    mixed: _Floats
    work: _Floats


def plane(b: float, nu: float, dq: float, y: _Floats | None = None) -> Plane:
    """Return the grid for a speed of the boundary; `y`: distances of two boundaries, one at either end."""
    wall, scale = y is not None, 1.0 if y is None else _COARSER
    y = _stretched(_FIRST, _LAST, _DEPTH, _CELLS) if y is None else y
    grazing, finest, coarsest = min(max(-nu, -_FINE_TO), _FINE_TO), scale * _FINEST, scale * _COARSEST
    ends = _FASTEST + grazing, _FASTEST - grazing
    below, above = (_stretched(finest, coarsest, end, math.ceil(1.25 * end / coarsest)) for end in ends)
    v = grazing + np.concatenate([-below[:0:-1], above])
    width, middle, weight = np.diff(v), density((v[1:] + v[:-1]) / 2), _trapezoid(v) * density(v)
    mixing = np.zeros((4, v.size))
    mixing[0, 1:], mixing[1, :-1] = b * middle / width / weight[1:], b * middle / width / weight[:-1]
    below, above = width[:-1], width[1:]
    mixing[2, 1:-1], mixing[3, 1:-1] = -above / below / (below + above), below / above / (below + above)
    place = y + (v + nu)[:, None] * dq
    source = np.clip(np.searchsorted(y, place, side="right") - 2, 0, y.size - 4)
    near, inside = y[source + np.arange(4)[:, None, None]], np.minimum(place, y[-1])
    share = ((place >= 0) & ((place <= y[-1]) | (not wall))) * np.ones(near.shape)  # nothing comes from behind a wall
    for k in range(4):
        for other in {0, 1, 2, 3} - {k}:
            share[k] *= (inside - near[other]) / (near[k] - near[other])
    scratch = np.zeros((2, *place.shape))
    return Plane(y, v, v + nu, dq, mixing, source, share, weight / weight.sum(), _trapezoid(y), *scratch)


@vector_kernel
def _mix(p: Plane, g: _Floats, c: float) -> None:
    """Set `mixed` to the state g after v has mixed: (1 + (1 - 2 a) dq L) / (1 - a dq L)^2, a = 1 - 1/sqrt 2."""
    mixing, mixed, work, y = p.mixing, p.mixed, p.work, p.y
    explicit, h = (1 - 2 * _GAMMA) * p.dq, _GAMMA * p.dq
    slopes, distances = g.shape
    for k in range(slopes):
        low, high = max(k - 1, 0), min(k + 1, slopes - 1)
        for i in range(distances):
            down, up = mixing[0, k] + (c - y[i]) * mixing[2, k], mixing[1, k] + (c - y[i]) * mixing[3, k]
            mixed[k, i] = g[k, i] + explicit * (down * (g[low, i] - g[k, i]) + up * (g[high, i] - g[k, i]))
    for _ in range(2):
        for k in range(slopes):
            low = max(k - 1, 0)  # at k = 0 the rate downwards is 0
            for i in range(distances):
                down = h * (mixing[0, k] + (c - y[i]) * mixing[2, k])
                up = h * (mixing[1, k] + (c - y[i]) * mixing[3, k])
                pivot = 1 / (1 + up + down - down * work[low, i])
                work[k, i] = up * pivot
                mixed[k, i] = (mixed[k, i] + down * mixed[low, i]) * pivot
        for k in range(slopes - 2, -1, -1):
            for i in range(distances):
                mixed[k, i] += work[k, i] * mixed[k + 1, i]


@vector_kernel
def _move(p: Plane, g: _Floats) -> None:
    """Set g to the state `mixed` after y has moved."""
    source, share, mixed = p.source, p.share, p.mixed
    for k in range(g.shape[0]):
        for i in range(g.shape[1]):
            j = source[k, i]
            near = share[0, k, i] * mixed[k, j] + share[1, k, i] * mixed[k, j + 1]
            g[k, i] = near + share[2, k, i] * mixed[k, j + 2] + share[3, k, i] * mixed[k, j + 3]


@kernel
def _advance(p: Plane, g: _Floats, c: float, shift: float, steps: int) -> None:
    """Take the state g through steps of time, between which the boundary shifts."""
    for _ in range(steps):
        _mix(p, g, c)
        _move(p, g)
        c += shift


def _leaving(p: Plane, g: _Floats, c: float) -> _Floats:
    """Return the probability of a state, and the integrals of u and of u^2 over what leaves."""
    u, edge = np.maximum(p.u, 0), g[:, 0] * p.v_weight
    return np.array([p.v_weight @ g @ (p.y_weight * density(c - p.y)), edge @ u, edge @ u**2])


def _passages(p: Plane, g: _Floats, c: float) -> tuple[float, float]:
    """Return H / phi(c) and the mean speed at a passage; take g one step of time on, and its probability to 1."""
    moments = _leaving(p, g, c)
    _mix(p, g, c)
    moments += _leaving(p, p.mixed, c)
    _move(p, g)
    g /= moments[0] / 2
    return float(moments[1] / moments[0]), float(moments[2] / max(moments[1], 1e-300))


def _rest(p: Plane, g: _Floats, c: float, time: float) -> tuple[float, float]:
    """Return the passages after a long time at one place of the boundary, compared every `time`; change g to then."""
    before, found = 0.0, _passages(p, g, c)
    while abs(found[0] - before) > _SETTLED * found[0]:
        before = found[0]
        _advance(p, g, c, 0.0, math.ceil(time / p.dq))
        found = _passages(p, g, c)
    return found


def two_pole_ramp(b: float, nu: float, path: _Floats, rest: tuple[Plane, _Floats] | None = None) -> _Floats:
    """Return (nodes, 2): H / phi(c) of two poles and the mean speed at a passage, along a path of evenly spaced nodes.

    A boundary that recedes starts with the state `rest` at the first node.
    """
    spacing = float(path[1] - path[0])
    steps = math.ceil(abs(spacing / nu) * b / _STEP)
    p = plane(b, nu, abs(spacing / nu) / steps)
    if rest is None:
        g = np.ones(p.mixed.shape)
        _rest(p, g, path[0], 1.0)
    else:
        g = np.stack([np.interp(p.v, rest[0].v, column) for column in rest[1].T], axis=1)
    found = np.empty((path.size, 2))
    for k, c in enumerate(path):
        found[k] = _passages(p, g, c)
        _advance(p, g, c + spacing / steps, spacing / steps, steps - 1)
    return found


def two_poles(b: float) -> tuple[_Floats, _Floats]:
    """Return H / phi(c) of two poles over (C_TWO, SPEEDS), and the mean speed at a passage over Rice's."""
    found, receding = np.zeros((C_TWO.size, SPEEDS.size, 2)), np.flatnonzero(SPEEDS < 0)
    p, begin = plane(b, 0.0, _STEP / b), int(np.flatnonzero(C_TWO == _RECEDES_FROM)[0])
    g = np.ones(p.mixed.shape)
    for k in range(C_TWO.size)[::-1]:
        found[k, SPEEDS == 0] = _rest(p, g, C_TWO[k], b / 2)
        if k < begin:
            found[k, receding] = [_passages(p._replace(u=p.v + nu), g.copy(), C_TWO[k]) for nu in SPEEDS[receding]]
        if k == begin:
            rest = p, g.copy()
    for j, nu in enumerate(SPEEDS):
        if nu < 0:
            found[begin:, j] = two_pole_ramp(b, nu, C_TWO[begin:], rest)
        if nu > 0:
            found[::-1, j] = two_pole_ramp(b, nu, C_TWO[::-1])
    speed = found[..., 1] / rice(np.maximum(SPEEDS, _SLOWEST))[1]
    speed[:, SPEEDS < _SLOWEST] = speed[:, SPEEDS >= _SLOWEST][:, :1]
    return found[..., 0], speed


def two_pole_pair(b: float, above: float, below: float) -> tuple[float, float]:
    """Return the hazards of two poles at two still thresholds, so far above and below the mean."""
    half = _stretched(_FIRST, _LAST, (above + below) / 2, _CELLS_PAIR)
    p = plane(b, 0.0, _COARSER * _STEP / b, np.concatenate([half, above + below - half[-2::-1]]))
    g = np.ones(p.mixed.shape)
    up = density(above) * _rest(p, g, above, b / 2)[0]
    return float(up), float(density(below)) * _passages(p, g[::-1, ::-1].copy(), below)[0]


# Tables


def tabled(c: _Floats, hazard: _Floats) -> _Floats:
    """Return H / ((1 + |nu|) phi(max(c, 0))) over (c, RHO) from H / phi(c) over (c, SPEEDS)."""
    from scipy.special import ndtr

    scaled = np.column_stack([np.zeros(c.size), hazard / (1 + abs(SPEEDS)), 1 / ndtr(c)])
    return np.asarray(scaled * density(np.minimum(c, 0))[:, None] / density(0.0))


def pair_table(nodes: _Floats, hazards: Callable[[float, float], tuple[float, float]]) -> _Floats:
    """Return F over (nodes, nodes); a threshold at the last node is so far away that it counts as none."""
    flux = np.full((nodes.size, nodes.size), np.nan)
    for i, j in zip(*np.tril_indices(nodes.size), strict=True):
        if nodes[i] + nodes[j] >= _LEAST_GAP:
            flux[i, j], flux[j, i] = hazards(nodes[i], nodes[j])
    ratio: _Floats = flux / flux[:, -1:]
    for i, j in np.argwhere(np.isnan(ratio))[::-1]:
        ratio[i, j] = ratio[i + 1, j + 1]
    return ratio


def exit_quantiles() -> _Floats:
    """Return the quantiles of Rice's density u phi(u - nu) over (EXIT_SPEEDS, probability)."""
    probability, table = np.append(np.arange(64) / 64, 1 - 1 / 600), []
    for nu in EXIT_SPEEDS:
        u = np.linspace(0, 1, 20_001) ** 2 * (max(nu, -2.0) + 7)
        rate = u * np.exp((min(nu, 0.0) ** 2 - (u - nu) ** 2) / 2)
        share = np.append(0.0, np.cumsum(np.diff(u) * (rate[1:] + rate[:-1])))
        table.append(np.interp(probability, share / share[-1], u))
    return np.array(table)


def write_tables(path: Path = HAZARDS) -> None:
    """Compute the tables and write them, as float32."""
    one = tabled(C_ONE, np.stack([one_pole(nu) for nu in SPEEDS], axis=1))
    tables = {"exit": exit_quantiles(), "one": one, "one_start": one_start(one)}
    tables["one_pair"] = pair_table(PAIR_ONE, one_pole_pair)
    _LOG.info("one pole: done")
    hazards, speeds, pairs = [], [], []
    for b in 1 / INVERSE_B:
        hazard, speed = two_poles(b)
        hazards.append(tabled(C_TWO, hazard))
        speeds.append(np.column_stack([speed[:, 0], speed, np.ones(C_TWO.size)]))
        pairs.append(pair_table(PAIR_TWO, functools.partial(two_pole_pair, b)))
        _LOG.info("two poles, b = %.2f: done", b)
    tables |= {"two": np.stack(hazards), "two_speed": np.stack(speeds), "two_pair": np.stack(pairs)}
    small: dict[str, Any] = {name: table.astype(np.float32) for name, table in tables.items()}
    np.savez_compressed(path, **small)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO)
    write_tables()
