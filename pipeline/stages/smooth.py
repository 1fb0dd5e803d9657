"""Stage 70: polynomials over the found coordinates, contact re-established, every entry and midpoint re-tested."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field

from pipeline.adapters.joint_work import Joint, SolverSettings
from pipeline.artifacts import ANATOMY, LIGAMENTS, MOVING_BODY, RAW_TABLE, REFERENCE_BODY, SMOOTH_TABLE, SWEEP_FACTS
from pipeline.contact_params import ContactParams, fibres_of
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage
from pipeline.errors import CaseRejected
from pipeline.kinematics.cell import Cell, Claim, Proof, failed_cell
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.interpolation import found_at, pose_curves, usable_entries
from pipeline.kinematics.midpoints import shared_error
from pipeline.kinematics.smoothing import Entry, Probe, Settled, ends, entries, fit_curves
from pipeline.kinematics.sweep import angles_rad, pose_table
from pipeline.kinematics.table import Float, Grid, PoseTable, RawTable, SmoothTable, Status


class Params(ContactParams):
    """Degrees of the polynomials and how the result is proven."""

    contact_band_mm: float = Field(
        0.145, gt=0, le=1, description="features closer than this hold an entry (one arc minute at 0.5 m)"
    )
    degree_flexion: int = Field(6, ge=0, le=20, description="degree in flexion (the paper's 6)")
    degree_varus: int = Field(3, ge=0, le=6, description="degree in varus, lowered until midpoints hold their limit")
    midpoint_limit_mm: float = Field(
        0.145, gt=0, le=10, description="gap or overlap allowed half-way between entries (one arc minute at 0.5 m)"
    )
    midpoint_aim_mm: float = Field(
        0.04, gt=0, le=10, description="where a midpoint is farther from contact, entries share the error"
    )
    entry_allowance_mm: float = Field(
        0.015, ge=0, le=1, description="how far an entry may then stand off contact; 0 keeps every entry in contact"
    )
    fill_gap_deg: float = Field(
        25.0, ge=0, le=180, description="failed cells between usable ones at most this far apart are smoothed over"
    )


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Smooth the table and prove it."""
    raw, anatomy = reads[RAW_TABLE], reads[ANATOMY]
    pair = params.pair(reads[REFERENCE_BODY], reads[MOVING_BODY], anatomy)
    facts = reads[SWEEP_FACTS]
    fibres = fibres_of(reads[LIGAMENTS], anatomy, pair, facts.push_n, facts.reference_strain)
    joint = Joint(pair, SolverSettings(proof=params.proof(), fibres=fibres), out.jobs)
    wanted = min(params.degree_varus, raw.grid.shape[1] - 1)
    table = _smoothed(raw, wanted, params, joint)
    degree = wanted
    for lower in range(wanted - 1, -1, -1):
        if _worst_midpoint(table) <= params.midpoint_limit_mm:
            break
        trial = _smoothed(raw, lower, params, joint)
        if _shown(trial) >= _shown(table) and _worst_midpoint(trial) < _worst_midpoint(table):
            table, degree = trial, lower
    out[SMOOTH_TABLE] = table
    return _findings(table, wanted, degree)


def _smoothed(raw: RawTable, degree_varus: int, params: Params, joint: Joint) -> SmoothTable:
    """The table with curves of one degree in varus, in contact and tested."""
    try:
        fits = fit_curves(raw, (params.degree_flexion, degree_varus))
    except ValueError as error:
        raise CaseRejected(
            "E-SMO-01", f"The curves cannot be smoothed: {error}.", "Narrow the range of angles or lower the degree."
        ) from error
    cells = _in_rows(_cells(joint, entries(raw, fits, params.fill_gap_deg)), raw.grid)
    poses, contact_error = pose_table(cells), np.array([[_contact_error(cell.proof) for cell in row] for row in cells])
    between = _half_way(raw.grid, poses)
    contact_mm = _contact_depths(raw.grid, between, joint)
    push = shared_error(
        raw.grid, usable_entries(poses), contact_mm - between[..., 2], params.midpoint_aim_mm, params.entry_allowance_mm
    )
    if push.any():  # along delta alone: contact stays where it is
        poses = replace(poses, proximal_mm=poses.proximal_mm + push)
        contact_error = np.where(push == 0.0, contact_error, _outermost(contact_error, -push))
        between = _half_way(raw.grid, poses)
    return SmoothTable(
        grid=raw.grid,
        poses=poses,
        fits=fits,
        flexion_range_deg=ends(raw.grid.flexion_deg),
        varus_range_deg=ends(raw.grid.varus_deg),
        contact_error_mm=contact_error,
        midpoint_error_mm=contact_mm - between[..., 2],
    )


def _outermost(bound_mm: Float, shift_mm: Float) -> Float:
    """Bound of the signed way to contact of entries moved by ``shift_mm`` from poses proven within ``bound_mm``."""
    return np.asarray(shift_mm + np.copysign(bound_mm, shift_mm))


def _cells(joint: Joint, wanted: Sequence[Entry]) -> list[Cell]:
    """Every entry in contact, certified and proven; in the order of the entries."""
    settled = joint.settle(wanted)
    claimed = {k: claim for k, one in enumerate(settled) if (claim := _claim(one)) is not None}
    proofs = dict(zip(claimed, joint.prove(tuple(claimed.values()))[0], strict=True))
    return [
        Cell(claimed[k].pose, one.entry.status, 0, one.certificate, proofs[k])
        if k in claimed
        else failed_cell(Status.NO_CONTACT if one.entry.status.usable else one.entry.status)
        for k, one in enumerate(settled)
    ]


def _claim(one: Settled) -> Claim | None:
    if one.pose is None:
        return None
    return Claim(angles_rad((one.entry.flexion_deg, one.entry.varus_deg)), one.pose, one.certificate)


def _shown(table: SmoothTable) -> int:
    return int(usable_entries(table.poses).sum())


def _worst_midpoint(table: SmoothTable) -> float:
    known = np.abs(table.midpoint_error_mm[np.isfinite(table.midpoint_error_mm)])
    return float(known.max(initial=0.0))


def _in_rows(cells: list[Cell], grid: Grid) -> list[list[Cell]]:
    columns = grid.shape[1]
    return [cells[k : k + columns] for k in range(0, len(cells), columns)]


def _contact_error(proof: Proof) -> float:
    """Bound of the signed way to contact: + where the entry is clear, - where it has to be pulled back."""
    return proof.gap_after_mm if proof.gap_before_mm == 0.0 else -proof.gap_before_mm


def _half_way_deg(grid: Grid) -> Float:
    """(F - 1, V, 2) flexion and varus in the middle between entries that follow one another in flexion."""
    flexion = 0.5 * (grid.flexion_deg[1:] + grid.flexion_deg[:-1])
    return np.stack(np.meshgrid(flexion, grid.varus_deg, indexing="ij"), axis=-1)


def _half_way(grid: Grid, poses: PoseTable) -> Float:
    """(F - 1, V, 4) found coordinates there, as a reader interpolates them; NaN where not covered."""
    angles = _half_way_deg(grid)
    return found_at(pose_curves(grid, poses), angles[..., 0], angles[..., 1])


def _contact_depths(grid: Grid, between: Float, joint: Joint) -> Float:
    """(F - 1, V) depth of first contact at the place and rotation of each such pose; NaN where not covered."""
    depth, covered = np.full(between.shape[:2], np.nan), np.isfinite(between).all(axis=-1)
    places = zip(_half_way_deg(grid)[covered], between[covered], strict=True)
    probes = [_probe(attitude, pose) for attitude, pose in places]
    depth[covered] = between[covered, 2] + joint.ways_to_contact(probes)
    return depth


def _probe(attitude: Float, found: Float) -> Probe:
    x, y, z, turn = (float(value) for value in found)
    return Probe(float(attitude[0]), float(attitude[1]), Pose(x, y, z, float(np.radians(turn))))


def _findings(table: SmoothTable, wanted: int, degree: int) -> Findings:
    out = []
    filled = int((table.poses.status == Status.SMOOTHED).sum())
    if filled:
        message = (
            f"{filled} attitudes without a stable pose were smoothed over: the curves of their neighbours, in contact."
        )
        out.append(Finding("N-SMO-01", Severity.NOTE, message))
    if degree < wanted:
        message = f"Degree {degree} instead of {wanted} in varus, so that contact holds between the entries as well."
        out.append(Finding("N-SMO-02", Severity.NOTE, message))
    return tuple(out)


STAGE = Stage(
    70,
    "smooth",
    (ANATOMY, REFERENCE_BODY, MOVING_BODY, LIGAMENTS, RAW_TABLE, SWEEP_FACTS),
    (SMOOTH_TABLE,),
    Params,
    run,
)
