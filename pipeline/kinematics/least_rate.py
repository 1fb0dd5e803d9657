"""The small linear programme of the solvers: the motion whose least advance over all contacts is greatest.

Four unknowns and some hundred rows: the simplex method on the dual, whose basis is 4 x 4, takes about ten steps of a
few array operations each, about an eighth of the time of a general solver.
"""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.joint_coordinates import Float

#: A row this far below the least advance is not violated (mm, far below any tolerance of contact).
OPTIMAL_MM = 1e-12
#: A column entry below this cannot be a pivot.
LEAST_PIVOT = 1e-12
MAX_STEPS = 200


def best_motion(rates: Float, slack: Float, box: tuple[float, float, float]) -> tuple[float, float, float]:
    """The motion in the box ``|motion| <= box`` that maximises the least of ``slack + rates @ motion``.

    Parameters
    ----------
    rates : (K, 3) float64
        Advance along delta per unit of (x, y, theta), for each contact; K > 0.
    slack : (K,) float64
        Advance that each contact leaves before any motion, mm; zeros ask for the best direction.
    box : (3,)
        Largest size of each component; 0 holds it.

    Returns
    -------
    (dx, dy, dtheta)
        A component that gains nothing stays zero, so that a body does not drift along a neutral direction.

    Notes
    -----
    With multipliers lambda on the contacts (sum 1) and mu on the six walls of the box, the dual is to minimise
    ``slack . lambda + box . mu`` subject to ``rates' lambda + mu+ - mu- = 0``. It starts from the contact with the
    least slack held by one wall in each direction; the entering column is the row of the primal violated most.
    """
    columns = np.vstack([np.column_stack([np.ones(len(rates)), rates]), *_walls()])
    costs = np.concatenate([slack, box, box])
    first = int(np.argmin(slack))
    basis = np.array([first, *(len(rates) + j + (3 if rates[first, j] > 0 else 0) for j in range(3))])
    prices = np.zeros(4)
    for _ in range(MAX_STEPS):
        inverse = np.linalg.inv(columns[basis].T)
        prices = costs[basis] @ inverse
        reduced = costs - columns @ prices
        enter = int(np.argmin(reduced))
        if reduced[enter] >= -OPTIMAL_MM:
            break
        leave = _leaving(inverse @ columns[enter], np.maximum(inverse[:, 0], 0.0))
        if leave is None:
            break
        basis[leave] = enter
    x, y, theta = _without_idle(-prices[1:], rates, slack)
    return float(x), float(y), float(theta)


def _without_idle(motion: Float, rates: Float, slack: Float) -> Float:
    """The motion with every component dropped whose loss lowers the least advance by nothing."""
    least = (slack + rates @ motion).min()
    for component in (2, 1, 0):
        trial = motion.copy()
        trial[component] = 0.0
        if (slack + rates @ trial).min() >= least - OPTIMAL_MM:
            motion = trial
    return motion


def _walls() -> tuple[Float, Float]:
    """Columns of the walls of the box: (0, +e) and (0, -e) for each component."""
    upper = np.column_stack([np.zeros(3), np.eye(3)])
    return upper, -upper


def _leaving(direction: Float, level: Float) -> int | None:
    """Row of the basis that reaches zero first when a column enters; None when none does."""
    possible = direction > LEAST_PIVOT
    if not possible.any():
        return None
    ratio = np.full(4, np.inf)
    ratio[possible] = level[possible] / direction[possible]
    return int(np.argmin(ratio))
