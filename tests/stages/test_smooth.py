"""Stage 70 on a joint whose poses are known: contact in every entry, midpoints measured."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts import (
    ANATOMY,
    LIGAMENTS,
    MOVING_BODY,
    RAW_TABLE,
    REFERENCE_BODY,
    SMOOTH_TABLE,
    SWEEP_FACTS,
)
from pipeline.engine.stage import Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.kinematics.smoothing import Entry, Settled, settle
from pipeline.kinematics.solvers import ExactSolver
from pipeline.kinematics.table import Float, Grid, PoseTable, RawTable, Status
from pipeline.records import LigamentFibre
from pipeline.stages.smooth import STAGE, Params
from tests.kinematics.hollow_joint import FACETS_MM, REST_MM, ball, hollow
from tests.report.sample import SWEEP
from tests.stages.in_memory import Run, anatomy

GRID = Grid(np.linspace(0.0, 40.0, 9), np.array([-2.0, 0.0, 2.0]))
PARAMS = Params(degree_flexion=3, eminence_mm=1.0)


def wandering() -> tuple[Float, Float, Float]:
    """Places of the ball that are polynomials of the attitude: x and y in mm, rotation in degrees."""
    u, v = np.meshgrid(GRID.flexion_deg / 20.0 - 1.0, GRID.varus_deg / 2.0, indexing="ij")
    return 1.0 * u + 0.3 * v, 0.5 - 0.8 * u**2 + 0.1 * u * v, 6.0 * u**3 - 2.0 * v


def raw_table(grid: Grid, failed: list[tuple[int, int]], offset_mm: float = 0.0) -> RawTable:
    """The ball resting at those places (z by the spheres' formula), with cells that failed."""
    x, y, rotation = (part[: grid.shape[0], : grid.shape[1]].copy() for part in wandering())
    z = np.sqrt(REST_MM**2 - x**2 - y**2) + offset_mm
    status, zeros = np.zeros(grid.shape, dtype=np.uint8), np.zeros(grid.shape)
    for cell in failed:
        status[cell] = Status.NOT_CONVERGED
        x[cell] = y[cell] = z[cell] = rotation[cell] = np.nan
    counts = np.zeros(grid.shape, dtype=np.int32)
    poses = PoseTable(x, y, z, rotation, status, zeros, zeros, zeros, counts)
    return RawTable(grid, poses, counts, *7 * (zeros,))


def inputs(raw: RawTable) -> dict[str, Any]:
    return {
        REFERENCE_BODY.name: hollow(),
        MOVING_BODY.name: ball(),
        ANATOMY.name: anatomy(np.eye(4), np.eye(4), (0.0,) * 6),
        LIGAMENTS.name: (),
        RAW_TABLE.name: raw,
        SWEEP_FACTS.name: SWEEP,
    }


def smoothed(raw: RawTable, params: Params = PARAMS, jobs: int = 1) -> tuple[Run, Findings]:
    run = Run(STAGE, inputs(raw), jobs)
    return run, run.go(params)


@pytest.fixture(scope="module")
def made() -> tuple[Run, Findings]:
    return smoothed(raw_table(GRID, [(3, 1), (0, 0)], offset_mm=0.05))


def test_places_are_those_of_the_polynomials(made: tuple[Run, Findings]) -> None:
    poses = made[0][SMOOTH_TABLE].poses
    shown = poses.status != Status.NOT_CONVERGED
    for name, expected in zip(("lateral_mm", "anterior_mm", "internal_rotation_deg"), wandering(), strict=True):
        np.testing.assert_allclose(getattr(poses, name)[shown], expected[shown], rtol=0, atol=1e-8)


def test_every_entry_is_in_contact_to_a_micrometre(made: tuple[Run, Findings]) -> None:
    table = made[0][SMOOTH_TABLE]
    x, y, _ = wandering()
    shown = table.poses.status != Status.NOT_CONVERGED
    np.testing.assert_array_less(np.abs(table.contact_error_mm[shown]), 1.0001e-3)
    expected = np.sqrt(REST_MM**2 - x**2 - y**2)
    np.testing.assert_allclose(table.poses.proximal_mm[shown], expected[shown], rtol=0, atol=FACETS_MM)


def test_midpoints_are_measured_where_both_ends_are_shown(made: tuple[Run, Findings]) -> None:
    error = made[0][SMOOTH_TABLE].midpoint_error_mm
    assert error.shape == (8, 3)
    assert np.isnan(error[0, 0])
    measured = np.delete(error.ravel(), 0)
    # facets change from entry to entry: what a reader interpolates is off by no more
    np.testing.assert_array_less(np.abs(measured), FACETS_MM)
    assert np.ptp(measured) > 1e-5


def test_entries_share_the_error_of_midpoints_and_say_so(made: tuple[Run, Findings]) -> None:
    exact = made[0][SMOOTH_TABLE]
    worst = float(np.nanmax(np.abs(exact.midpoint_error_mm)))
    params = PARAMS.model_copy(update={"midpoint_aim_mm": 0.7 * worst, "entry_allowance_mm": 0.8 * worst})
    shared = smoothed(raw_table(GRID, [(3, 1), (0, 0)], offset_mm=0.05), params)[0][SMOOTH_TABLE]
    assert np.nanmax(np.abs(shared.midpoint_error_mm)) <= 0.7 * worst + 1e-6
    push = shared.poses.proximal_mm - exact.poses.proximal_mm
    shown = np.isfinite(push)
    assert 0.1 * worst < np.abs(push[shown]).max() <= 0.8 * worst + 1e-12
    # what is told of an entry bounds where it stands: beyond its push by no more than the proof of contact
    assert np.all(np.abs(shared.contact_error_mm[shown] + push[shown]) <= np.abs(exact.contact_error_mm[shown]) + 1e-12)


def test_a_failed_cell_between_usable_ones_is_shown_and_said(made: tuple[Run, Findings]) -> None:
    run, findings = made
    status = run[SMOOTH_TABLE].poses.status
    assert status[3, 1] == Status.SMOOTHED
    assert status[0, 0] == Status.NOT_CONVERGED
    assert [(one.code, one.severity) for one in findings] == [("N-SMO-01", Severity.NOTE)]
    assert findings[0].message.startswith("1 attitudes without a stable pose were smoothed over")


def test_curves_and_ends_are_kept(made: tuple[Run, Findings]) -> None:
    table = made[0][SMOOTH_TABLE]
    assert [fit.name for fit in table.fits] == ["lateral_mm", "anterior_mm", "internal_rotation_deg"]
    np.testing.assert_array_equal(table.flexion_range_deg, [0.0, 40.0])
    np.testing.assert_array_equal(table.varus_range_deg, [-2.0, 2.0])
    assert max(fit.residual_rms for fit in table.fits) < 1e-9


def test_gaps_wider_than_the_setting_stay_open() -> None:
    raw = raw_table(GRID, [(3, 1)])
    table = smoothed(raw, PARAMS.model_copy(update={"fill_gap_deg": 9.0}))[0][SMOOTH_TABLE]
    assert table.poses.status[3, 1] == Status.NOT_CONVERGED
    assert np.isnan(table.contact_error_mm[3, 1])
    np.testing.assert_array_equal(np.isnan(table.midpoint_error_mm[:, 1]), [False, False, True, True] + 4 * [False])


def test_a_table_of_one_attitude_has_no_midpoints() -> None:
    table = smoothed(raw_table(Grid(np.array([0.0]), np.array([0.0])), []))[0][SMOOTH_TABLE]
    assert table.midpoint_error_mm.shape == (0, 1)
    assert abs(table.contact_error_mm[0, 0]) <= 1e-3


def test_a_lower_degree_in_varus_is_taken_only_where_it_serves_the_midpoints() -> None:
    """x runs with varus here: lowering the degree moves entries, but their midpoints stay as good as the facets."""
    kept, findings = smoothed(raw_table(GRID, []))
    assert [fit.coefficients.shape for fit in kept[SMOOTH_TABLE].fits] == [(4, 3)] * 3
    assert findings == ()
    strict, said = smoothed(raw_table(GRID, []), PARAMS.model_copy(update={"midpoint_limit_mm": 1e-5}))
    worst = [float(np.abs(run[SMOOTH_TABLE].midpoint_error_mm).max()) for run in (strict, kept)]
    degree = strict[SMOOTH_TABLE].fits[0].coefficients.shape[1] - 1
    assert worst[0] <= worst[1]
    assert [one.code for one in said] == (["N-SMO-02"] if degree < 2 else [])


def test_too_few_usable_cells_are_refused() -> None:
    raw = raw_table(GRID, [cell for cell in np.ndindex(GRID.shape) if cell[0] > 1])
    with pytest.raises(CaseRejected, match="E-SMO-01 The curves cannot be smoothed: 6 usable cells cannot carry"):
        smoothed(raw)


def test_a_table_that_was_jumping_is_in_contact_all_the_same() -> None:
    """One cell that the sweep found 1 mm beside its neighbours, deep in another dent."""
    raw = raw_table(GRID, [])
    x, z = raw.poses.lateral_mm.copy(), raw.poses.proximal_mm.copy()
    x[4, 1] += 1.0
    z[4, 1] += 0.4
    table = smoothed(replace(raw, poses=replace(raw.poses, lateral_mm=x, proximal_mm=z)))[0][SMOOTH_TABLE]
    assert table.poses.lateral_mm[4, 1] == pytest.approx(wandering()[0][4, 1], abs=1e-6)
    np.testing.assert_array_less(np.abs(table.contact_error_mm), 1.0001e-3)
    assert table.fits[0].residual_max == pytest.approx(1.0, abs=1e-6)


def test_an_entry_that_has_to_be_pulled_back_has_a_negative_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """The proof is that of the collision library, whatever the solver holds to be contact."""

    def too_deep(solver: ExactSolver, entry: Entry) -> Settled:
        settled = settle(solver, entry)
        assert settled.pose is not None
        return settled._replace(pose=settled.pose._replace(z=settled.pose.z + 3e-3))

    monkeypatch.setattr("pipeline.adapters.joint_work.settle", too_deep)
    table = smoothed(raw_table(Grid(np.array([0.0]), np.array([0.0])), []))[0][SMOOTH_TABLE]
    assert table.contact_error_mm[0, 0] == -5e-3


def test_an_entry_that_meets_nothing_is_not_shown() -> None:
    """The curves lead one entry 40 mm aside, past the rim of the bowl."""
    grid = Grid(np.array([0.0, 20.0, 40.0]), np.array([0.0]))
    raw = raw_table(grid, [])
    aside = replace(raw.poses, lateral_mm=np.array([[0.0], [0.0], [40.0]]))
    table = smoothed(replace(raw, poses=aside))[0][SMOOTH_TABLE]
    np.testing.assert_array_equal(table.poses.status, [[Status.OK], [Status.OK], [Status.NO_CONTACT]])
    np.testing.assert_array_equal(np.isnan(table.contact_error_mm), [[False], [False], [True]])


@pytest.mark.parametrize(("push_n", "left_over"), [(8.0, 0.0), (0.0, 2.62 / REST_MM)])
def test_ligaments_that_pulled_in_the_sweep_are_in_the_balance(push_n: float, left_over: float) -> None:
    """Against 8 N this spring holds the ball 2.62 mm aside, where else the slope of the wall would be left over."""
    fibre = LigamentFibre("spring", (40.0, 0.0, 0.0), (0.0, 0.0, 0.0), slack_mm=1.0, stiffness_n=0.1)
    raw = raw_table(Grid(np.array([0.0]), np.array([0.0])), [])
    aside = replace(raw.poses, lateral_mm=np.array([[2.62]]), anterior_mm=np.zeros((1, 1)))
    run = Run(STAGE, {**inputs(replace(raw, poses=aside)), LIGAMENTS.name: (fibre,)})
    run.given[SWEEP_FACTS.name] = replace(SWEEP, push_n=push_n)
    run.go(PARAMS.model_copy(update={"contact_band_mm": 0.005}))
    assert run[SMOOTH_TABLE].poses.equilibrium_residual[0, 0] == pytest.approx(left_over, abs=0.06)


def test_two_jobs_give_the_same_bytes(made: tuple[Run, Findings]) -> None:
    run, findings = smoothed(raw_table(GRID, [(3, 1), (0, 0)], offset_mm=0.05), jobs=2)
    assert findings == made[1]
    assert SMOOTH_TABLE.encode(run[SMOOTH_TABLE]) == SMOOTH_TABLE.encode(made[0][SMOOTH_TABLE])
