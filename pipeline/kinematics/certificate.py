"""The equilibrium certificate: a proof of a stable pose that does not care who found it.

At a stable pose there are multipliers lambda_i >= 0 on the contacts with

    sum lambda_i n_i + delta = 0                     (force, three equations)
    sum lambda_i ((r_i - c) x n_i) . delta = 0       (torque about delta, scaled by the paper's 30 mm radius)
"""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.contact import Contacts

#: Radius of the circle that encloses the tibia in the paper; makes the torque equation dimensionless.
TORQUE_RADIUS_MM = 30.0


def equilibrium_residual(contacts: Contacts) -> float:
    """Length of what the contacts cannot balance of a unit push along delta: 0 is equilibrium, 1 is none at all.

    Parameters
    ----------
    contacts : Contacts
        In the attitude frame (delta is z). Without contacts nothing is balanced and the residual is 1.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - half a second that a cached run does not spend

    if len(contacts) == 0:
        return 1.0
    n = contacts.normals
    r = contacts.points - contacts.points.mean(axis=0)
    torque = (r[:, 0] * n[:, 1] - r[:, 1] * n[:, 0]) / TORQUE_RADIUS_MM
    push = np.array([0.0, 0.0, 1.0, 0.0])
    _, residual = nnls(np.vstack([n.T, torque]), -push)
    return float(residual)
