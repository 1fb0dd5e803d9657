"""The small linear programme of the solvers: the motion whose least advance over all contacts is greatest."""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.joint_coordinates import Float

#: Advance along delta per unit of motion (mm or rad) below which contacts promise nothing (rounding of the normals).
LEAST_PROMISE = 1e-6


def best_motion(rates: Float, slack: Float, box: tuple[float, float, float]) -> tuple[float, float, float]:
    """The motion in the box ``|motion| <= box`` that maximises the least of ``slack + rates @ motion``.

    Parameters
    ----------
    rates : (K, 3) float64
        Advance along delta per unit of (x, y, theta), for each contact.
    slack : (K,) float64
        Advance that each contact leaves before any motion, mm; zeros ask for the best direction.
    box : (3,)
        Largest size of each component; 0 holds it.

    Returns
    -------
    (dx, dy, dtheta)
        The smallest such motion: zeros when nothing advances, and no drift along directions that change nothing.
    """
    from scipy.optimize import linprog  # noqa: PLC0415 - half a second that a cached run does not spend

    columns = np.column_stack([-rates, rates, np.ones(len(rates))])
    bounds = [(0.0, b) for b in box] * 2 + [(None, None)]
    price = [LEAST_PROMISE] * 6 + [-1.0]
    answer = linprog(price, A_ub=columns, b_ub=slack, bounds=bounds, method="highs")
    if answer.x is None:
        return 0.0, 0.0, 0.0
    dx, dy, dtheta = answer.x[:3] - answer.x[3:6]
    return float(dx), float(dy), float(dtheta)
