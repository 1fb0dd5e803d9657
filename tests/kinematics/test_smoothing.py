"""Smoothing: polynomials recovered, flagged cells left out, contact re-established along delta."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import chebyshev, polynomial

from pipeline.kinematics.cell import NO_CERTIFICATE, Claim, prove
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.direct.solver import DirectSolver
from pipeline.kinematics.smoothing import (
    HUBER_BOUND,
    Entry,
    Probe,
    entries,
    evaluate,
    fit_curves,
    scaled,
    settle,
    way_to_contact,
)
from pipeline.kinematics.table import Float, Grid, PoseTable, RawTable, Status
from tests.kinematics.hollow_joint import FACETS_MM, PROOF, REST_MM, direct, hollow_pair

GRID = Grid(np.linspace(0.0, 120.0, 13), np.linspace(-4.0, 4.0, 5))
BAD = np.uint8(Status.SLID_OFF)
CURVES = ("lateral_mm", "anterior_mm", "internal_rotation_deg")


def raw_table(grid: Grid, values: tuple[Float, Float, Float], z_mm: Float | None = None) -> RawTable:
    """A raw table with these x, y and rotation; every cell OK."""
    zeros, counts = np.zeros(grid.shape), np.zeros(grid.shape, dtype=np.int32)
    x, y, rotation = (np.array(value) for value in values)
    poses = PoseTable(
        lateral_mm=x, anterior_mm=y, proximal_mm=zeros if z_mm is None else z_mm, internal_rotation_deg=rotation,
        status=np.zeros(grid.shape, dtype=np.uint8), equilibrium_residual=zeros, medial_gap_mm=zeros,
        lateral_gap_mm=zeros, contact_count=counts,
    )  # fmt: skip
    return RawTable(grid, poses, counts, *7 * (zeros,))


def flagged(raw: RawTable, cells: list[tuple[int, int]], hidden: float = np.nan) -> RawTable:
    """The table with cells that failed; ``hidden`` stands in their place."""
    status, z = raw.poses.status.copy(), raw.poses.proximal_mm.copy()
    changed = {name: getattr(raw.poses, name).copy() for name in CURVES}
    for cell in cells:
        status[cell], z[cell] = BAD, np.nan
        for values in changed.values():
            values[cell] = hidden
    return replace(raw, poses=replace(raw.poses, status=status, proximal_mm=z, **changed))


def polynomials(grid: Grid, degrees: tuple[int, int], seed: int = 5) -> tuple[tuple[Float, Float, Float], Float]:
    """Values of three random polynomials of total degree up to the larger, and their power coefficients."""
    p, q = degrees
    made = np.random.default_rng(seed).normal(size=(3, p + 1, q + 1))
    i, j = np.indices((p + 1, q + 1))
    made[:, i + j > max(p, q)] = 0.0
    u = scaled(grid.flexion_deg, grid.flexion_deg[[0, -1]])
    v = scaled(grid.varus_deg, grid.varus_deg[[0, -1]])
    x, y, rotation = (polynomial.polygrid2d(u, v, one) for one in made)
    return (x, y, rotation), made


@pytest.mark.parametrize("degrees", [(6, 2), (6, 0), (3, 3), (1, 2)])
def test_a_polynomial_is_recovered(degrees: tuple[int, int]) -> None:
    values, _ = polynomials(GRID, degrees)
    fits = fit_curves(raw_table(GRID, values), degrees)
    assert [(fit.name, fit.unit) for fit in fits] == list(zip(CURVES, ("mm", "mm", "deg"), strict=True))
    for fit, expected in zip(fits, values, strict=True):
        np.testing.assert_allclose(evaluate(fit, GRID), expected, rtol=0, atol=1e-9)
        assert fit.residual_rms < 1e-9
        assert fit.residual_max < 1e-9


def test_terms_go_up_to_the_total_degree() -> None:
    values, _ = polynomials(GRID, (6, 2))
    noise = np.random.default_rng(0).normal(size=GRID.shape)
    fit = fit_curves(raw_table(GRID, (values[0] + noise, values[1], values[2])), (6, 2))[0]
    assert fit.coefficients.shape == (7, 3)
    i, j = np.indices((7, 3))
    assert np.all(fit.coefficients[i + j > 6] == 0.0)
    assert np.all(fit.coefficients[i + j <= 6] != 0.0)


def test_the_curve_is_the_chebyshev_series_of_its_coefficients() -> None:
    values, _ = polynomials(GRID, (6, 2), seed=8)
    fit = fit_curves(raw_table(GRID, values), (6, 2))[1]
    u, v = np.meshgrid(GRID.flexion_deg / 60.0 - 1.0, GRID.varus_deg / 4.0, indexing="ij")
    np.testing.assert_allclose(evaluate(fit, GRID), chebyshev.chebval2d(u, v, fit.coefficients), rtol=0, atol=1e-12)


def test_residuals_are_raw_minus_fitted_and_balanced_by_huber() -> None:
    noise = np.random.default_rng(1).normal(size=GRID.shape)
    fit = fit_curves(raw_table(GRID, (noise, noise, noise)), (6, 2))[0]
    off = noise - evaluate(fit, GRID)
    assert fit.residual_rms == pytest.approx(np.sqrt(np.mean(off**2)))
    assert fit.residual_max == pytest.approx(np.abs(off).max())
    # what is left, clipped at Huber's bound, is orthogonal to every term of the basis
    clipped = np.clip(off, *(np.array([-1.0, 1.0]) * HUBER_BOUND * 1.4826 * np.median(np.abs(off))))
    u, v = np.meshgrid(GRID.flexion_deg / 60.0 - 1.0, GRID.varus_deg / 4.0, indexing="ij")
    for i, j in ((0, 0), (1, 0), (6, 0), (4, 2), (0, 2)):
        term = chebyshev.chebval(u, np.eye(7)[i]) * chebyshev.chebval(v, np.eye(7)[j])
        assert (clipped * term).sum() == pytest.approx(0.0, abs=0.02)


def test_cells_that_jump_do_not_bend_the_curve() -> None:
    values, _ = polynomials(GRID, (6, 2))
    jumped = values[1].copy()
    jumped[[2, 7, 9, 11], [1, 3, 0, 4]] += [5.0, -4.0, 6.0, 5.0]
    fit = fit_curves(raw_table(GRID, (values[0], jumped, values[2])), (6, 2))[1]
    np.testing.assert_allclose(evaluate(fit, GRID), values[1], rtol=0, atol=1e-6)
    assert fit.residual_max == pytest.approx(6.0, abs=1e-6)


@pytest.mark.parametrize("hidden", [np.nan, 1e6])
def test_flagged_cells_do_not_enter_the_fit(hidden: float) -> None:
    values, _ = polynomials(GRID, (6, 2))
    raw = flagged(raw_table(GRID, values), [(0, 0), (5, 2), (6, 2), (12, 4)], hidden)
    for fit, expected in zip(fit_curves(raw, (6, 2)), values, strict=True):
        np.testing.assert_allclose(evaluate(fit, GRID), expected, rtol=0, atol=1e-8)


def test_fewer_usable_cells_than_terms_are_refused() -> None:
    values, _ = polynomials(GRID, (6, 2))
    kept = {(row, 2) for row in range(13)} | {(row, 0) for row in range(4)}
    failed = [cell for cell in np.ndindex(GRID.shape) if cell not in kept]
    with pytest.raises(ValueError, match="17 usable cells cannot carry a polynomial of 18 terms"):
        fit_curves(flagged(raw_table(GRID, values), failed), (6, 2))


def test_cells_that_leave_the_polynomial_free_are_refused() -> None:
    """One row of seven failed: degree 6 is free by the product of (flexion - the other six rows)."""
    grid = Grid(np.linspace(0.0, 60.0, 7), np.array([-2.0, 0.0, 2.0]))
    values, _ = polynomials(grid, (6, 2))
    failed = flagged(raw_table(grid, values), [(3, 0), (3, 1), (3, 2)])
    with pytest.raises(ValueError, match="usable cells do not lie so that a polynomial of 18 terms is determined"):
        fit_curves(failed, (6, 2))
    fit_curves(failed, (5, 2))


def test_degrees_are_lowered_to_what_the_grid_can_carry() -> None:
    grid = Grid(np.array([0.0, 30.0, 60.0]), np.array([0.0]))
    column = np.array([[1.0], [2.0], [5.0]])
    fit = fit_curves(raw_table(grid, (column, column, column)), (6, 2))[0]
    assert fit.coefficients.shape == (3, 1)
    np.testing.assert_allclose(evaluate(fit, grid), column, rtol=0, atol=1e-12)


def test_a_grid_of_one_attitude_keeps_its_value() -> None:
    grid = Grid(np.array([30.0]), np.array([1.0]))
    one = np.full((1, 1), 2.5)
    raw = raw_table(grid, (one, one, one), z_mm=one)
    fits = fit_curves(raw, (6, 2))
    assert [float(evaluate(fit, grid)[0, 0]) for fit in fits] == pytest.approx([2.5, 2.5, 2.5])
    (entry,) = entries(raw, fits, 25.0)
    assert entry[:4] == (0, 0, 30.0, 1.0)
    assert entry.start == pytest.approx((2.5, 2.5, 2.5, np.radians(2.5)))
    assert entry.status is Status.OK


def test_scaling_takes_the_ends_to_minus_one_and_one() -> None:
    np.testing.assert_allclose(scaled(np.array([10.0, 20.0, 40.0]), np.array([10.0, 40.0])), [-1.0, -1.0 / 3.0, 1.0])
    np.testing.assert_array_equal(scaled(np.array([5.0]), np.array([5.0, 5.0])), [0.0])


# --- entries


def smoothed_statuses(failed: list[int], gap_deg: float) -> list[Status]:
    """Of one column in steps of 5 degrees."""
    grid = Grid(np.linspace(0.0, 60.0, 13), np.array([0.0]))
    column = np.zeros(grid.shape)
    raw = flagged(raw_table(grid, (column, column, column)), [(row, 0) for row in failed])
    return [entry.status for entry in entries(raw, fit_curves(raw, (2, 0)), gap_deg)]


@pytest.mark.parametrize(
    ("failed", "gap_deg", "smoothed"),
    [
        ([4], 10.0, [4]),  # a single cell: its usable neighbours are two steps apart
        ([4], 9.9, []),
        ([4, 5], 10.0, []),
        ([4, 5], 15.0, [4, 5]),
        ([3, 5], 10.0, [3, 5]),
        ([2, 6, 7, 8], 10.0, [2]),
        ([0, 1], 180.0, []),  # nothing below
        ([12], 180.0, []),  # nothing above
    ],
)
def test_failed_cells_are_smoothed_over_where_usable_ones_are_near_on_both_sides(
    failed: list[int], gap_deg: float, smoothed: list[int]
) -> None:
    statuses = smoothed_statuses(failed, gap_deg)
    assert [row for row, status in enumerate(statuses) if status is Status.SMOOTHED] == smoothed
    remaining = [row for row in failed if row not in smoothed]
    assert [row for row, status in enumerate(statuses) if status is Status.SLID_OFF] == remaining


def test_a_failed_cell_is_not_bridged_from_another_column() -> None:
    values, _ = polynomials(GRID, (2, 1))
    raw = flagged(raw_table(GRID, values), [(row, 2) for row in range(12)])
    status = {(entry.row, entry.column): entry.status for entry in entries(raw, fit_curves(raw, (2, 1)), 180.0)}
    assert all(status[(row, 2)] is Status.SLID_OFF for row in range(12))


def test_contact_is_looked_for_from_the_raw_depth_or_the_least_of_the_column() -> None:
    values, _ = polynomials(GRID, (6, 2))
    z = np.linspace(-10.0, 2.0, 65).reshape(GRID.shape)
    made = flagged(raw_table(GRID, values, z_mm=z), [(4, 1)])
    found = {(entry.row, entry.column): entry for entry in entries(made, fit_curves(made, (6, 2)), 25.0)}
    assert found[(7, 3)].start.z == z[7, 3]
    assert found[(4, 1)].start.z == z[0, 1]
    assert found[(7, 3)][:4] == (7, 3, 70.0, 2.0)
    assert found[(7, 3)].start.x == pytest.approx(values[0][7, 3], abs=1e-8)
    assert found[(7, 3)].start.theta == pytest.approx(np.radians(values[2][7, 3]), abs=1e-8)


# --- contact


@pytest.fixture(scope="module")
def solver() -> DirectSolver:
    return direct()


@pytest.mark.parametrize("start_z", [REST_MM - 2.0, REST_MM + 0.3])
def test_an_entry_settles_at_contact_from_before_and_from_beyond(solver: DirectSolver, start_z: float) -> None:
    x, y = 1.5, -0.8
    entry = Entry(0, 0, 20.0, 3.0, Pose(x, y, start_z, 0.4), Status.SMOOTHED)
    settled = settle(solver, entry)
    assert settled.entry == entry
    assert settled.pose is not None
    assert (settled.pose.x, settled.pose.y, settled.pose.theta) == (x, y, 0.4)
    assert settled.pose.z == pytest.approx(np.sqrt(REST_MM**2 - x**2 - y**2), abs=FACETS_MM)


def test_a_settled_entry_is_proven_on_both_sides_by_the_collision_library(solver: DirectSolver) -> None:
    entry = Entry(0, 0, 20.0, 3.0, Pose(1.5, -0.8, 0.0, 0.4), Status.OK)
    settled = settle(solver, entry)
    assert settled.pose is not None
    assert settled.certificate.contact_count > 0
    claim = Claim((np.radians(20.0), np.radians(3.0)), settled.pose, settled.certificate)
    proof = prove(hollow_pair().bodies(), claim, PROOF.ladder_mm)
    assert proof.gap_before_mm == 0.0
    assert proof.gap_after_mm <= 2e-4


def test_entries_that_cannot_be_shown_stay_so(solver: DirectSolver) -> None:
    failed = Entry(0, 0, 20.0, 3.0, Pose(0.0, 0.0, 0.0, 0.0), Status.NOT_CONVERGED)
    assert settle(solver, failed) == (failed, None, NO_CERTIFICATE)
    beside = Entry(0, 0, 20.0, 3.0, Pose(40.0, 0.0, 0.0, 0.0), Status.OK)
    assert settle(solver, beside) == (beside, None, NO_CERTIFICATE)


@pytest.mark.parametrize("way_mm", [-0.2, 0.0, 0.35])
def test_the_way_to_contact_is_positive_for_a_gap_and_negative_for_an_intersection(
    solver: DirectSolver, way_mm: float
) -> None:
    at_contact = settle(solver, Entry(0, 0, 10.0, 0.0, Pose(0, 0, 5.0, 0), Status.OK)).pose
    assert at_contact is not None
    probe = Probe(10.0, 0.0, at_contact._replace(z=at_contact.z - way_mm))
    assert way_to_contact(solver, probe) == pytest.approx(way_mm, abs=1e-9)


def test_no_contact_has_no_way(solver: DirectSolver) -> None:
    assert np.isnan(way_to_contact(solver, Probe(0.0, 0.0, Pose(60.0, 0, 0, 0))))
