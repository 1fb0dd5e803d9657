"""The measured motion of ``knee_jam`` solved with flexion alone given: varus floats until both compartments touch."""

from __future__ import annotations

from functools import cache

import numpy as np

from pipeline.adapters.contact_pool import ContactPair
from pipeline.adapters.joint_work import Joint, SolverSettings, claims
from pipeline.kinematics.joint_coordinates import Float
from pipeline.kinematics.ligaments import NO_FIBRES
from pipeline.kinematics.sweep import Evidence, Hysteresis, assemble, hysteresis, kept, walk_grid
from pipeline.kinematics.table import Grid, RawTable
from tests.validate import Measurement, Row
from tests.validate.measured_motion import KNEE, MOVING, REFERENCE, body_of, fibres, pose_of, smoothed_frames

EMINENCE_MM = 5.0
VARUS_DEG = np.linspace(-5.0, 5.0, 11)
JOBS = 2


def _table(joint: Joint, grid: Grid, frame: Float) -> RawTable:
    """Stable poses over the grid, from a frame on, with the clearance of both compartments."""
    flexion, varus = np.degrees(frame[:2])
    ways = walk_grid(grid, (float(flexion), float(varus)), pose_of(frame), lambda walks: joint.walk(walks, _unheard))
    found = kept(ways)
    known = joint.certify(grid, found)
    claimed = claims(grid, found, known)
    proofs = dict(zip(claimed, joint.prove(tuple(claimed.values()))[0], strict=True))
    passes: Hysteresis = hysteresis(grid, ways)
    return assemble(grid, found, Evidence(known, proofs), passes)


def _unheard(_: int) -> None:
    """Progress that nobody follows."""


@cache
def differences(ligaments: bool) -> Float:  # noqa: FBT001 - the key of the cache
    """(N, 5) solved minus measured and smoothed: varus, rotation (deg), lateral, anterior, proximal (mm)."""
    frames = smoothed_frames()
    frames = frames[np.argsort(frames[:, 0])]
    pair = ContactPair(body_of(REFERENCE), body_of(MOVING), EMINENCE_MM)
    joint = Joint(pair, SolverSettings(fibres=fibres() if ligaments else NO_FIBRES), JOBS)
    first = frames[len(frames) // 2]
    table = _table(joint, Grid(np.degrees(frames[:, 0]), VARUS_DEG), first)
    curve = joint.neutral(table, float(np.degrees(first[1])), pose_of(first))
    solved = np.column_stack(
        [curve.varus_deg, curve.internal_rotation_deg, curve.lateral_mm, curve.anterior_mm, curve.proximal_mm]
    )
    return np.asarray(solved - np.column_stack([np.degrees(frames[:, 1:3]), frames[:, 3:]]))


def _rows(ligaments: bool, key: str, limits: tuple[float, ...]) -> tuple[Measurement, ...]:  # noqa: FBT001 - variant
    """RMS over the frames that have a neutral pose."""

    def measure(column: int, part: str, name: str, unit: str) -> Measurement:
        def row() -> Row:
            rms = float(np.sqrt(np.nanmean(differences(ligaments)[:, column] ** 2)))
            title = f"knee_jam, neutral, {'with' if ligaments else 'no'} ligaments: {name}"
            return Row(f"{key}_{part}", title, rms, unit, limits[column])

        return row

    def missing() -> Row:
        count = float(np.isnan(differences(ligaments)[:, 0]).sum())
        return Row(f"{key}_missing", "knee_jam, neutral: frames without a pose", count, "", limits[5])

    return (
        measure(0, "varus_deg", "varus", "deg"),
        measure(1, "theta_deg", "rotation", "deg"),
        measure(2, "ml_mm", "mediolateral", "mm"),
        measure(3, "ap_mm", "anteroposterior", "mm"),
        measure(4, "pd_mm", "proximodistal", "mm"),
        missing,
    )


ROWS: tuple[Measurement, ...] = (
    (
        *_rows(False, "jam_neutral_bare", (2.3, 5.1, 1.2, 2.5, 0.7, 0.0)),
        *_rows(True, "jam_neutral", (1.5, 1.9, 1.3, 1.3, 0.35, 6.0)),
    )
    if KNEE.exists()
    else ()
)
