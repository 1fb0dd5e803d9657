"""Neutral varus: at each flexion the varus at which both compartments touch, as a knee stands that nothing bends aside.

Varus is let float between two columns of the table where the compartment that is open changes sides: the difference of
the clearances of both compartments along delta is brought to zero by regula falsi (Illinois), each time with the
stable pose of the varus tried.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.kinematics.contact import Pose
from pipeline.kinematics.solvers import ExactSolver
from pipeline.kinematics.sweep import angles_rad
from pipeline.kinematics.table import Float, RawTable, Status

#: The search ends when the compartments differ by less than this, mm.
EVEN_MM = 0.01
MOST_TRIALS = 12


@dataclass(frozen=True, eq=False)
class NeutralCurve:
    """The pose of neutral varus at each flexion of the table, all arrays (F,); NaN where ``status`` is not usable.

    Attributes
    ----------
    flexion_deg, varus_deg : float64
        The varus found.
    lateral_mm, anterior_mm, proximal_mm, internal_rotation_deg : float64
        As in the table.
    uneven_mm : float64
        Clearance of the lateral compartment along delta minus that of the medial one.
    status : uint8
        Values of Status; NO_CONTACT where no varus of the table lets both sides touch.
    """

    flexion_deg: Float
    varus_deg: Float
    lateral_mm: Float
    anterior_mm: Float
    proximal_mm: Float
    internal_rotation_deg: Float
    uneven_mm: Float
    status: NDArray[np.uint8]


class Bracket(NamedTuple):
    """Two neighbouring varus angles (deg) of one flexion between which the open side changes, with their poses."""

    flexion_deg: float
    varus_deg: tuple[float, float]
    poses: tuple[Pose, Pose]
    centre: Pose


class Compartments(NamedTuple):
    """The whole joint, and each compartment of the moving body alone against the same reference."""

    whole: ExactSolver
    medial: ExactSolver
    lateral: ExactSolver


class NeutralPose(NamedTuple):
    """What was found at one flexion."""

    varus_deg: float
    pose: Pose
    uneven_mm: float
    status: Status


NOT_FOUND = NeutralPose(float("nan"), Pose(*4 * (float("nan"),)), float("nan"), Status.NO_CONTACT)


def brackets(raw: RawTable, neutral_deg: float, centre: Pose) -> tuple[Bracket | None, ...]:
    """For each flexion the neighbours nearest to a varus between which the open side changes; None without."""
    poses = raw.poses
    uneven = poses.lateral_gap_mm - poses.medial_gap_mm
    out: list[Bracket | None] = []
    for row, flexion in enumerate(raw.grid.flexion_deg):
        columns = np.flatnonzero(uneven[row, :-1] * uneven[row, 1:] <= 0.0)
        if not len(columns):
            out.append(None)
            continue
        middle = 0.5 * (raw.grid.varus_deg[columns] + raw.grid.varus_deg[columns + 1])
        column = int(columns[np.argmin(np.abs(middle - neutral_deg))])
        sides = (column, column + 1)
        out.append(
            Bracket(
                float(flexion),
                (float(raw.grid.varus_deg[sides[0]]), float(raw.grid.varus_deg[sides[1]])),
                (_pose(raw, row, sides[0]), _pose(raw, row, sides[1])),
                centre,
            )
        )
    return tuple(out)


def _pose(raw: RawTable, row: int, column: int) -> Pose:
    at, poses = (row, column), raw.poses
    turn = float(np.radians(poses.internal_rotation_deg[at]))
    return Pose(float(poses.lateral_mm[at]), float(poses.anterior_mm[at]), float(poses.proximal_mm[at]), turn)


def neutral_pose(joint: Compartments, bracket: Bracket | None) -> NeutralPose:
    """The varus within a bracket at which both compartments touch, and the stable pose there."""
    if bracket is None:
        return NOT_FOUND
    low, high = (_tried(joint, bracket, varus, pose) for varus, pose in zip(*bracket[1:3], strict=True))
    weight = [low.uneven_mm, high.uneven_mm]
    best = min(low, high, key=lambda one: abs(one.uneven_mm))
    for _ in range(MOST_TRIALS):
        if not (low.status.usable and high.status.usable) or abs(best.uneven_mm) <= EVEN_MM:
            break
        share = weight[0] / (weight[0] - weight[1]) if weight[0] != weight[1] else 0.5
        trial = _tried(joint, bracket, low.varus_deg + share * (high.varus_deg - low.varus_deg), best.pose)
        best = min(best, trial, key=lambda one: abs(one.uneven_mm))
        # Illinois: an end that stays counts half, or it would stay for ever
        if trial.uneven_mm * low.uneven_mm > 0.0:
            low, weight = trial, [trial.uneven_mm, 0.5 * weight[1]]
        else:
            high, weight = trial, [0.5 * weight[0], trial.uneven_mm]
    return best if best.status.usable else NOT_FOUND


def _tried(joint: Compartments, bracket: Bracket, varus_deg: float, start: Pose) -> NeutralPose:
    """The stable pose at one varus, and how much farther from contact the lateral side is than the medial one."""
    angles = angles_rad((bracket.flexion_deg, varus_deg))
    found = joint.whole.at(angles).solve(start, bracket.centre)
    medial, lateral = (part.at(angles).depth(found.pose) for part in (joint.medial, joint.lateral))
    if not found.status.usable or medial is None or lateral is None:
        return NOT_FOUND
    return NeutralPose(varus_deg, found.pose, lateral.z - medial.z, found.status)


def neutral_curve(flexion_deg: Float, found: tuple[NeutralPose, ...]) -> NeutralCurve:
    """The curve of what was found at each flexion."""
    poses = np.array([one.pose for one in found])
    return NeutralCurve(
        flexion_deg=flexion_deg,
        varus_deg=np.array([one.varus_deg for one in found]),
        lateral_mm=poses[:, 0],
        anterior_mm=poses[:, 1],
        proximal_mm=poses[:, 2],
        internal_rotation_deg=np.degrees(poses[:, 3]),
        uneven_mm=np.array([one.uneven_mm for one in found]),
        status=np.array([one.status for one in found], dtype=np.uint8),
    )
