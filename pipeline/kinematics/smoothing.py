"""Smoothing: least-squares polynomials of x, y and rotation over the grid, contact re-established along delta.

The basis is Chebyshev, both angles scaled to [-1, 1]; terms of total degree up to P in flexion and varus and of degree
up to Q in varus (P = 6, the paper). With total degree 6 the fit is a polynomial of two variables in the sense of
OpenSim's MultivariatePolynomialFunction, so nothing is lost in that export.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from pipeline.kinematics.cell import NO_CERTIFICATE, Certificate
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.solvers import ExactSolver
from pipeline.kinematics.sweep import angles_rad
from pipeline.kinematics.table import CurveFit, Float, Grid, PoseTable, RawTable, Status

#: Huber's bound: 95 % as efficient as plain least squares where nothing jumps.
HUBER_BOUND = 1.345
HUBER_ROUNDS = 20
#: A pose with one compartment this far open counts half as much (mm).
LOOSE_MM = 1.0

CURVES = (("lateral_mm", "mm"), ("anterior_mm", "mm"), ("internal_rotation_deg", "deg"))


class Entry(NamedTuple):
    """One entry to be made: its place in the table, its attitude in degrees, where to look for contact, its status."""

    row: int
    column: int
    flexion_deg: float
    varus_deg: float
    start: Pose
    status: Status


class Probe(NamedTuple):
    """An attitude between entries (degrees) and the pose a reader would interpolate there."""

    flexion_deg: float
    varus_deg: float
    pose: Pose


def scaled(values: Float, ends: Float) -> Float:
    """Values with the two ends taken to -1 and 1; zeros where the ends are equal."""
    half = 0.5 * (ends[1] - ends[0])
    return (values - 0.5 * (ends[0] + ends[1])) / half if half > 0 else np.zeros_like(values)


def ends(values: Float) -> Float:
    """(2,) first and last of increasing values."""
    return np.array([values[0], values[-1]])


def fit_curves(raw: RawTable, degrees: tuple[int, int]) -> tuple[CurveFit, ...]:
    """Robust least-squares fit of each found coordinate over the cells whose status is OK.

    Huber's weights (1964) in 20 rounds: where roughness or a lifted compartment lets single cells jump, the others keep
    the curve. Cells with one compartment open count less: there the surfaces hold the body loosely.

    Parameters
    ----------
    raw : RawTable
    degrees : (P, Q)
        Wanted degree in flexion and varus; lowered where the grid has fewer values.

    Raises
    ------
    ValueError
        When the usable cells are too few for the degrees, or leave out so many values of an angle that the polynomial
        is free between them.
    """
    usable = raw.poses.status == Status.OK
    p, q = min(degrees[0], raw.grid.shape[0] - 1), min(degrees[1], raw.grid.shape[1] - 1)
    terms = _terms(p, q)
    if usable.sum() < len(terms):
        raise ValueError(f"{int(usable.sum())} usable cells cannot carry a polynomial of {len(terms)} terms")
    design = _design(raw.grid, terms)[usable.ravel()]
    if np.linalg.matrix_rank(design) < len(terms):
        raise ValueError(f"the usable cells do not lie so that a polynomial of {len(terms)} terms is determined")
    held = _held(raw.poses)[usable]
    return tuple(_fit((name, unit), getattr(raw.poses, name)[usable], design, held, terms) for name, unit in CURVES)


def _held(poses: PoseTable) -> Float:
    """(F, V) weight of each cell: 1 where both compartments touch, less where one is open and little holds the pose."""
    open_mm = np.nan_to_num(np.fmax(poses.medial_gap_mm, poses.lateral_gap_mm))
    return np.asarray(1.0 / np.sqrt(1.0 + (open_mm / LOOSE_MM) ** 2))


def _terms(p: int, q: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(p + 1) for j in range(q + 1) if i + j <= max(p, q)]


def _design(grid: Grid, terms: Sequence[tuple[int, int]]) -> Float:
    flexion = chebyshev.chebvander(scaled(grid.flexion_deg, ends(grid.flexion_deg)), max(i for i, _ in terms))
    varus = chebyshev.chebvander(scaled(grid.varus_deg, ends(grid.varus_deg)), max(j for _, j in terms))
    columns = [np.outer(flexion[:, i], varus[:, j]).ravel() for i, j in terms]
    return np.column_stack(columns)


def _fit(
    curve: tuple[str, str], values: Float, design: Float, held: Float, terms: Sequence[tuple[int, int]]
) -> CurveFit:
    weight = held
    for _ in range(HUBER_ROUNDS):
        solution = np.linalg.lstsq(design * weight[:, None], values * weight, rcond=None)[0]
        residual = values - design @ solution
        usual = max(1.4826 * float(np.median(np.abs(residual))), 1e-9)
        weight = held / np.sqrt(np.maximum(np.abs(residual) / (HUBER_BOUND * usual), 1.0))
    coefficients = np.zeros((max(i for i, _ in terms) + 1, max(j for _, j in terms) + 1))
    for (i, j), value in zip(terms, solution, strict=True):
        coefficients[i, j] = value
    rms = float(np.sqrt(np.mean(residual**2)))
    return CurveFit(*curve, coefficients, rms, float(np.abs(residual).max()))


def evaluate(fit: CurveFit, grid: Grid) -> Float:
    """(F, V) the fitted coordinate at every attitude of the grid it was fitted on."""
    flexion = scaled(grid.flexion_deg, ends(grid.flexion_deg))
    varus = scaled(grid.varus_deg, ends(grid.varus_deg))
    return np.asarray(chebyshev.chebgrid2d(flexion, varus, fit.coefficients), dtype=np.float64)


def entries(raw: RawTable, fits: Sequence[CurveFit], gap_deg: float) -> tuple[Entry, ...]:
    """What to re-establish contact for: usable cells, and failed ones between usable ones at most ``gap_deg`` apart.

    A failed cell lies between the nearest usable ones of its own column, below and above in flexion.
    """
    x, y, turn = (evaluate(fit, raw.grid) for fit in fits)
    out = []
    for row, flexion in enumerate(raw.grid.flexion_deg):
        for column, varus in enumerate(raw.grid.varus_deg):
            status = _smoothed_status(raw.poses.status[:, column], raw.grid.flexion_deg, row, gap_deg)
            at = (row, column)
            start = Pose(float(x[at]), float(y[at]), _depth(raw.poses, at), float(np.radians(turn[at])))
            out.append(Entry(row, column, float(flexion), float(varus), start, status))
    return tuple(out)


def _smoothed_status(column: NDArray[np.uint8], flexion_deg: Float, row: int, gap_deg: float) -> Status:
    usable = np.flatnonzero(column == Status.OK)
    below, above = usable[usable < row], usable[usable > row]
    if column[row] == Status.OK or not (len(below) and len(above)):
        return Status(int(column[row]))
    bridged = flexion_deg[above[0]] - flexion_deg[below[-1]] <= gap_deg
    return Status.SMOOTHED if bridged else Status(int(column[row]))


def _depth(poses: PoseTable, at: tuple[int, int]) -> float:
    """Raw z of the cell, or the least of its column where it failed: contact is looked for from there."""
    own, column = float(poses.proximal_mm[at]), poses.proximal_mm[:, at[1]]
    if np.isfinite(own):
        return own
    return float(np.nanmin(column)) if np.isfinite(column).any() else 0.0


class Settled(NamedTuple):
    """An entry brought to contact along delta: its pose (None where it meets nothing), its certificate."""

    entry: Entry
    pose: Pose | None
    certificate: Certificate


def settle(solver: ExactSolver, entry: Entry) -> Settled:
    """One entry of the smoothed table: x, y and rotation as fitted, z by contact."""
    if not entry.status.usable:
        return Settled(entry, None, NO_CERTIFICATE)
    attitude = solver.at(angles_rad((entry.flexion_deg, entry.varus_deg)))
    pose = attitude.depth(entry.start)
    return Settled(entry, pose, NO_CERTIFICATE if pose is None else attitude.certify(pose))


def way_to_contact(solver: ExactSolver, probe: Probe) -> float:
    """Signed way along delta from a pose to first contact, mm: + a gap, - an intersection; NaN without contact."""
    pose = solver.at(angles_rad((probe.flexion_deg, probe.varus_deg))).depth(probe.pose)
    return float("nan") if pose is None else pose.z - probe.pose.z
