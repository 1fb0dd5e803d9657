"""The equilibrium certificate: a proof of a stable pose that does not care who found it.

At a stable pose there are multipliers lambda_i >= 0 on the contacts with

    sum lambda_i n_i + delta = 0                     (force, three equations)
    sum lambda_i ((r_i - c) x n_i) . delta = 0       (torque about delta, scaled by the paper's 30 mm radius)

Ligaments add their pull and their torque to the push delta that the contacts have to balance.
"""

from __future__ import annotations

import numpy as np

from pipeline.kinematics.contact import Contacts
from pipeline.kinematics.joint_coordinates import Float
from pipeline.kinematics.ligaments import NO_LOAD, Load

#: Radius of the circle that encloses the tibia in the paper; makes the torque equation dimensionless.
TORQUE_RADIUS_MM = 30.0
#: A column that shortens what is left by less than this (of a unit push) does not help.
NO_HELP = 1e-12


def equilibrium_residual(contacts: Contacts, load: Load = NO_LOAD) -> float:
    """Length of what the contacts cannot balance of a unit push along delta: 0 is equilibrium, 1 is none at all.

    Parameters
    ----------
    contacts : Contacts
        In the attitude frame (delta is z). Without contacts nothing is balanced and the residual is 1.
    load : Load
        What the fibres do at the pose, attitude frame; balanced together with the push.
    """
    if len(contacts) == 0:
        return 1.0
    centre = contacts.points.mean(axis=0)
    torques = _about_delta(contacts.points - centre, contacts.normals) / TORQUE_RADIUS_MM
    return _least_residual(np.vstack([contacts.normals.T, torques]), _wanted(load, centre))


def _wanted(load: Load, centre: Float) -> Float:
    """(4,) force and scaled torque about the centre with which contacts hold against the push and the fibres."""
    x, y, theta, z = load.slope
    arm = np.array([load.origin]) - centre[:2]
    torque = theta + _about_delta(arm, np.array([[x, y]]))[0]
    return np.array([x, y, z - 1.0, torque / TORQUE_RADIUS_MM])


def _about_delta(arms: Float, forces: Float) -> Float:
    """(K,) torque of forces about delta."""
    return arms[:, 0] * forces[:, 1] - arms[:, 1] * forces[:, 0]


def _least_residual(columns: Float, wanted: Float) -> float:
    """Least length of ``columns @ multipliers - wanted`` for multipliers that are not negative.

    Columns are let in one at a time, the one that helps most first: a handful of some hundred is enough.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - half a second that a cached run does not spend

    chosen, left = list[int](), wanted
    while True:
        help_ = left @ columns
        best = int(np.argmax(help_))
        if help_[best] <= NO_HELP or best in chosen:
            return float(np.linalg.norm(left))
        chosen.append(best)
        multipliers, _ = nnls(columns[:, chosen], wanted)
        left = wanted - columns[:, chosen] @ multipliers
