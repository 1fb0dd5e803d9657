"""The small linear programme of the direct solver (compiled)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.kinematics.compilation import compiled, inlined
from pipeline.kinematics.direct.surfaces import Float
from pipeline.kinematics.least_rate import LEAST_PIVOT, MAX_STEPS, OPTIMAL_MM

Index = NDArray[np.int64]


class Basis(NamedTuple):
    """A vertex of the dual programme.

    Attributes
    ----------
    inverse : (4, 4) float64
        Of the matrix of the basic columns.
    costs, prices : (4,) float64
        Of the basic columns; of the four equations.
    column : (4,) float64
        The one that enters.
    """

    inverse: Float
    costs: Float
    prices: Float
    column: Float


@compiled
def best_motion(rates: Float, slack: Float, rows: Index, box: Float, motion: Float) -> float:
    """The motion in the box that maximises the least of ``slack + rates @ motion`` over some rows; the gain.

    The dual simplex method of :mod:`pipeline.kinematics.least_rate`, its 4 x 4 basis inverse updated in place.

    Parameters
    ----------
    rates, slack : (S, 3), (S,) float64
    rows : (K,) int64
        Which of them count; K > 0.
    box : (3,) float64
        Largest size of each component.
    motion : (3,) float64
        Written.

    Returns
    -------
    float
        The least of ``slack + rates @ motion``.
    """
    first = rows[0]
    for k in rows:
        if slack[k] < slack[first]:
            first = k
    basis = Basis(np.zeros((4, 4)), np.zeros(4), np.zeros(4), np.zeros(4))
    basis.inverse[0, 0], basis.costs[0] = 1.0, slack[first]
    for j in range(3):
        sign = -1.0 if rates[first, j] > 0.0 else 1.0
        basis.inverse[j + 1, 0], basis.inverse[j + 1, j + 1] = -sign * rates[first, j], sign
        basis.costs[j + 1] = box[j]
    for _ in range(MAX_STEPS):
        for j in range(4):
            basis.prices[j] = 0.0
            for r in range(4):
                basis.prices[j] += basis.costs[r] * basis.inverse[r, j]
        cost = _entering(rates, slack, rows, box, basis)
        if np.isnan(cost) or not _exchange(basis, cost):
            break
    for j in range(3):
        motion[j] = -basis.prices[j + 1]
    _drop_idle(rates, slack, rows, motion)
    least: float = basis.prices[0]
    return least


@compiled
def _drop_idle(rates: Float, slack: Float, rows: Index, motion: Float) -> None:
    """Set to zero every component that gains nothing, so that a body does not drift along a neutral direction."""
    least = _advance(rates, slack, rows, motion)
    for j in (2, 1, 0):
        kept, motion[j] = motion[j], 0.0
        if _advance(rates, slack, rows, motion) < least - OPTIMAL_MM:
            motion[j] = kept


@inlined
def _advance(rates: Float, slack: Float, rows: Index, motion: Float) -> float:
    """The least of ``slack + rates @ motion`` over some rows."""
    least, x, y, turn = np.inf, motion[0], motion[1], motion[2]
    for k in rows:
        least = min(least, slack[k] + rates[k, 0] * x + rates[k, 1] * y + rates[k, 2] * turn)
    return least


@inlined
def _entering(rates: Float, slack: Float, rows: Index, box: Float, basis: Basis) -> float:
    """Write the column violated most and return its cost; NaN when none is."""
    least, enter = -OPTIMAL_MM, -1
    p0, p1, p2, p3 = basis.prices[0], basis.prices[1], basis.prices[2], basis.prices[3]
    for k in rows:
        reduced = slack[k] - p0 - rates[k, 0] * p1 - rates[k, 1] * p2 - rates[k, 2] * p3
        if reduced < least:
            least, enter = reduced, k
    cost, column = np.nan, basis.column
    if enter >= 0:
        cost = slack[enter]
        column[0], column[1], column[2], column[3] = 1.0, rates[enter, 0], rates[enter, 1], rates[enter, 2]
    for j in range(3):
        for sign in (1.0, -1.0):
            reduced = box[j] - sign * basis.prices[j + 1]
            if reduced < least:
                least, cost = reduced, box[j]
                column[:] = 0.0
                column[j + 1] = sign
    return cost


@inlined
def _exchange(basis: Basis, cost: float) -> bool:
    """Let a column enter the basis in place of the row that reaches zero first; False when none does."""
    inverse, column, direction = basis.inverse, basis.column, np.zeros(4)
    leave, ratio = -1, np.inf
    for r in range(4):
        for j in range(4):
            direction[r] += inverse[r, j] * column[j]
        if direction[r] > LEAST_PIVOT:
            reached = max(inverse[r, 0], 0.0) / direction[r]
            if reached < ratio:
                leave, ratio = r, reached
    if leave < 0:
        return False
    for j in range(4):
        inverse[leave, j] /= direction[leave]
    for r in range(4):
        if r != leave:
            for j in range(4):
                inverse[r, j] -= direction[r] * inverse[leave, j]
    basis.costs[leave] = cost
    return True
