"""Ligament fibres between the two bodies, as springs and cords: what they pull with at a pose.

With fibres, a stable pose is a local maximum of its merit: depth along delta minus elastic energy over the push. That
is the same search with one smooth term more, and one load more in the balance of forces. Both solvers and the
certificate take the fibres as :class:`Fibres`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.kinematics.joint_coordinates import Float

#: Pull of a cord per mm of stretch, over the push: it does not stretch, but the push would lengthen it by 0.008 mm.
CORD_STIFFNESS = 125.0
#: Share of the push that the fibres leave to the contacts at least: held off the reference there is no stable contact.
LEAST_PUSH = 1e-3


class Fibres(NamedTuple):
    """Fibres as a solver sees them, forces as multiples of the push along delta.

    Attributes
    ----------
    on_reference : (K, 3) float64
        Attachments on the reference, mm; in its own frame, or turned into the attitude frame.
    on_moving : (K, 3) float64
        Attachments on the moving body, its own frame, mm.
    slack_mm : (K,) float64
        Length below which a fibre is slack.
    stiffness : (K,) float64
        Pull per mm of stretch beyond the slack length, divided by the push.
    """

    on_reference: Float
    on_moving: Float
    slack_mm: Float
    stiffness: Float


NO_FIBRES = Fibres(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Ligaments:
    """Fibres with their properties, attachments in the kinematic frames.

    Attributes
    ----------
    names : tuple of str
    on_reference, on_moving : (K, 3) float64
        mm.
    slack_mm : (K,) float64
        Length at which each begins to pull; above 0.
    stiffness_n : (K,) float64
        Pull (N) per unit of strain beyond slack; infinite for a cord.
    """

    names: tuple[str, ...]
    on_reference: Float
    on_moving: Float
    slack_mm: Float
    stiffness_n: Float

    def fibres(self, push_n: float) -> Fibres:
        """As a solver takes them, for a push of so many newtons; none is stiffer than a cord."""
        stiffness = np.minimum(self.stiffness_n / self.slack_mm / push_n, CORD_STIFFNESS)
        return Fibres(self.on_reference, self.on_moving, self.slack_mm, stiffness)


def slack_from_scan(scan_length_mm: Float, stiffness_n: Float, reference_strain: float) -> Float:
    """Slack lengths (K,) of fibres of which the scan is all that is known.

    Parameters
    ----------
    scan_length_mm : (K,) float64
        Length of each at the scan pose.
    stiffness_n : (K,) float64
        Infinite for a cord.
    reference_strain : float
        How far beyond slack every spring is stretched at the scan pose; above -1. A cord is just taut there.
    """
    return scan_length_mm / (1.0 + np.where(np.isinf(stiffness_n), 0.0, reference_strain))


class Load(NamedTuple):
    """What the fibres do at a pose, divided by the push.

    Attributes
    ----------
    energy_mm : float
        Elastic energy.
    slope : (4,) float64
        Its change per mm of x and y, per rad of theta and per mm of z: the force and the torque about delta that work
        against such a motion.
    origin : (x, y)
        Where the torque is taken about: the moving body's origin at the pose, mm.
    """

    energy_mm: float
    slope: Float
    origin: tuple[float, float]

    @property
    def push(self) -> float:
        """Force along delta that the contacts carry, over the push: what the merit gains per mm of depth."""
        return max(1.0 - float(self.slope[3]), LEAST_PUSH)


NO_LOAD = Load(0.0, np.zeros(4), (0.0, 0.0))


def fibre_load(fibres: Fibres, pose: tuple[float, float, float, float]) -> Load:
    """Elastic energy of the taut fibres and its slope.

    Parameters
    ----------
    fibres : Fibres
        Attachments on the reference in the attitude frame.
    pose : (x, y, theta, z)
        mm and rad, in the order of the solvers' unknowns.
    """
    if not len(fibres.slack_mm):
        return NO_LOAD  # the same as below, and no time lost on the searches that have none
    x, y, theta, z = pose
    c, s = np.cos(theta), np.sin(theta)
    arm = fibres.on_moving[:, :2] @ np.array([[c, s], [-s, c]])
    ends = np.column_stack([arm + np.array([x, y]), fibres.on_moving[:, 2] + z])
    way = ends - fibres.on_reference
    length = np.linalg.norm(way, axis=1)
    stretch = np.maximum(length - fibres.slack_mm, 0.0)
    tension = fibres.stiffness * stretch
    pull = way * (tension / np.maximum(length, 1e-9))[:, None]
    torque = arm[:, 0] * pull[:, 1] - arm[:, 1] * pull[:, 0]
    slope = np.array([pull[:, 0].sum(), pull[:, 1].sum(), torque.sum(), pull[:, 2].sum()])
    return Load(float(0.5 * tension @ stretch), slope, (x, y))
