"""Integrals over a pixel from the edges of facets.

The integral of a function over a facet is a sum over the facet's edges: each edge a -> b counts what lies between it
and the right end of the row. In the pixel that the edge crosses this is `piece`; pixels further right get the rest as
sums along the row (`bands`) or directly (`pixel`). With h = y1 - y0, p and q the columns of the ends less the pixel's:

    area        h (ua + ub) / 2,  ua = 1 - p, ub = 1 - q
    of x        h / 2 (1 - (p^2 + p q + q^2) / 3)
    of y        h / 6 (y0 (2 ua + ub) + y1 (ua + 2 ub))
    flux        w / 6 (l0 (2 q0 + q1) + l1 (q0 + 2 q1)),  q = vx dy - vy dx, w the piece's share of the edge, l the
                function on the edge

The time derivative of an integral of L is that of G less the flux of L through the moving edge (Reynolds' theorem).
"""

from __future__ import annotations

from emulator.raster.compiled import lane
from emulator.raster.layout import SHOWABLE, Data, Sign

__all__ = ["flux", "is_still", "piece"]


@lane
def piece(p: float, y0: float, q: float, y1: float) -> tuple[float, float, float]:
    """Return the integrals of 1, x and y between an edge's piece and its pixel's right side; pixel's own frame."""
    h = y1 - y0
    ua, ub = 1.0 - p, 1.0 - q
    of_x = 0.5 * h * (1.0 - (p * p + p * q + q * q) * (1.0 / 3.0))
    of_y = h * (1.0 / 6.0) * (y0 * (2.0 * ua + ub) + y1 * (ua + 2.0 * ub))
    return 0.5 * h * (ua + ub), of_x, of_y


@lane
def flux(share: float, l0: float, l1: float, q0: float, q1: float) -> float:
    """Return the flux of a function with the values l0, l1 at a piece's ends, moving with q0, q1."""
    return share * (1.0 / 6.0) * (l0 * (2.0 * q0 + q1) + l1 * (q0 + 2.0 * q1))


@lane
def is_still(data: Data, f: int, side: int) -> bool:
    """Return whether light is continuous across a side, so that no flux passes: the neighbour shares its radiance."""
    across, smooth, facets, kinds = data[2], data[3], data[4], data[5]
    g = across[f, side]
    same: bool = facets[g, Sign] == facets[f, Sign]
    gradients = bool(kinds[f] == SHOWABLE and kinds[g] == SHOWABLE)
    return same and gradients and bool(smooth[f, side] != 0)
