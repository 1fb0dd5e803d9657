"""The sweep: a spine and ribs that cover the grid, the way out kept, and a joint with the same answer everywhere."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.kinematics.cell import Cell, failed_cell
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.incremental import StablePose
from pipeline.kinematics.sweep import (
    Release,
    Walk,
    Walked,
    assemble,
    go,
    let_go,
    pose_table,
    ribs,
    spine,
)
from pipeline.kinematics.table import Grid, RawTable, Status
from tests.kinematics.hollow_joint import FACETS_MM, PLACE_MM, REST_MM, SETTINGS, hollow_pair

SCAN = Pose(0.5, -0.3, 5.0, 0.0)
GRID = Grid(np.linspace(0.0, 60.0, 7), np.array([-4.0, -2.0, 0.0, 2.0]))


def cell(z: float, x: float = 0.0, theta: float = 0.0, motions: int = 0) -> Cell:
    return Cell(Pose(x, 0.0, z, theta), Status.OK, motions, 0.01, 3, 0.1, 0.2, 0.0, 2e-4)


def walked(walk: Walk, failed: frozenset[int] = frozenset()) -> Walked:
    """A walk whose cells have their flexion as z; the rows in ``failed`` have slid off."""
    out = tuple(failed_cell(Status.SLID_OFF) if at[0] in failed else cell(GRID.flexion_deg[at[0]]) for at in walk.cells)
    return Walked(walk.cells, out, out)


def cells_of(*walks: Walk) -> list[tuple[int, int]]:
    return [at for walk in walks for at in walk.cells]


# --- walks


@pytest.mark.parametrize("flexion_deg", [31.0, 0.0, 60.0, -12.0, 95.0, 4.9, 5.1])
@pytest.mark.parametrize("varus_deg", [0.3, -9.0, 2.0])
def test_spine_and_ribs_cover_every_cell_once(flexion_deg: float, varus_deg: float) -> None:
    along = spine(GRID, flexion_deg, varus_deg, SCAN)
    across = ribs(GRID, [walked(walk) for walk in along], SCAN)
    assert sorted(cells_of(*along, *across)) == sorted(np.ndindex(GRID.shape))


@pytest.mark.parametrize("flexion_deg", [31.0, 0.0, 60.0, -12.0, 95.0])
def test_the_spine_leaves_the_scan_both_ways_at_the_varus_nearest_to_it(flexion_deg: float) -> None:
    along = spine(GRID, flexion_deg, -1.4, SCAN)
    assert {column for _, column in cells_of(*along)} == {1}
    nearest = int(np.argmin(np.abs(GRID.flexion_deg - flexion_deg)))
    for walk in along:
        assert abs(walk.cells[0][0] - nearest) <= 1
        assert set(np.abs(np.diff([row for row, _ in walk.cells]))) <= {1}
        assert (walk.start, walk.centre) == (SCAN, SCAN)
    assert [len(walk.cells) for walk in along] == sorted((len(walk.cells) for walk in along), reverse=True)
    assert nearest in [walk.cells[0][0] for walk in along]


def test_every_walk_goes_from_neighbour_to_neighbour_at_the_attitudes_of_its_cells() -> None:
    along = spine(GRID, 21.0, 0.0, SCAN)
    for walk in (*along, *ribs(GRID, [walked(one) for one in along], SCAN)):
        steps = np.abs(np.diff(walk.cells, axis=0)).sum(axis=1)
        np.testing.assert_array_equal(steps, 1)
        expected = [(GRID.flexion_deg[row], GRID.varus_deg[column]) for row, column in walk.cells]
        assert list(walk.attitudes_deg) == expected


def test_a_rib_starts_from_its_own_cell_of_the_spine_and_is_bound_about_the_scan() -> None:
    along = spine(GRID, 21.0, 0.0, SCAN)
    for walk in ribs(GRID, [walked(one) for one in along], SCAN):
        assert walk.start.z == GRID.flexion_deg[walk.cells[0][0]]
        assert walk.cells[0][1] in (1, 3)
        assert walk.centre == SCAN


def test_a_rib_of_a_failed_cell_starts_from_the_nearest_row_that_did_not_fail() -> None:
    along = spine(GRID, 21.0, 0.0, SCAN)
    across = ribs(GRID, [walked(one, frozenset({0, 1, 4})) for one in along], SCAN)
    starts = {walk.cells[0][0]: walk.start.z for walk in across}
    assert starts == {0: 20.0, 1: 20.0, 2: 20.0, 3: 30.0, 4: 30.0, 5: 50.0, 6: 60.0}


def test_a_rib_starts_where_only_the_way_back_found_a_pose() -> None:
    (walk,) = spine(Grid(np.array([0.0]), np.array([0.0, 1.0])), 0.0, 0.0, SCAN)
    found = Walked(walk.cells, (failed_cell(Status.SLID_OFF),), (cell(3.5),))
    (rib,) = ribs(Grid(np.array([0.0]), np.array([0.0, 1.0])), [found], SCAN)
    assert rib.start.z == 3.5


def test_without_a_spine_there_are_no_ribs_and_their_cells_stay_unreached() -> None:
    along = spine(GRID, 21.0, 0.0, SCAN)
    nothing = [walked(one, frozenset(range(7))) for one in along]
    assert ribs(GRID, nothing, SCAN) == ()
    status = assemble(GRID, nothing).poses.status
    np.testing.assert_array_equal(status[:, 2], Status.SLID_OFF)
    np.testing.assert_array_equal(status[:, [0, 1, 3]], Status.NOT_CONVERGED)


def test_a_grid_of_one_attitude_is_one_walk() -> None:
    grid = Grid(np.array([30.0]), np.array([1.0]))
    along = spine(grid, 8.0, -3.0, SCAN)
    assert [walk.cells for walk in along] == [((0, 0),)]
    assert ribs(grid, [Walked(along[0].cells, (cell(1.0),), (cell(1.0),))], SCAN) == ()


def test_a_walk_goes_out_and_back_from_the_last_usable_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each search is made to come to rest 1 mm deeper than it started; the third one slides off."""
    starts: list[float] = []

    def one_deeper(_: object, start: Pose, __: object, centre: Pose) -> StablePose:
        starts.append(start.z)
        assert centre == Pose(0.0, 0.0, 99.0, 0.0)
        status = Status.SLID_OFF if len(starts) == 3 else Status.OK
        return StablePose(start._replace(z=start.z + 1.0), status, len(starts), 0)

    monkeypatch.setattr("pipeline.kinematics.sweep.solve_incremental", one_deeper)
    monkeypatch.setattr("pipeline.kinematics.sweep.measured_cell", lambda _, pose, *others: cell(pose.z))
    cells = ((0, 0), (1, 0), (2, 0), (3, 0))
    walk = Walk(cells, tuple((10.0 * row, 0.0) for row, _ in cells), Pose(0, 0, 0, 0), Pose(0.0, 0.0, 99.0, 0.0))
    result = go(hollow_pair().bodies(), walk, SETTINGS)
    assert starts == [0, 1, 2, 2, 3, 4, 5, 6]
    assert [one.pose.z for one in result.out if one.status.usable] == [1, 2, 3]
    assert result.out[2].status is Status.SLID_OFF
    # in the order of the cells: the way back came to the first cell last
    assert [one.pose.z for one in result.back] == [7, 6, 5, 4]


# --- assembling


def assembled(out: Cell, back: Cell) -> RawTable:
    return assemble(Grid(np.array([0.0]), np.array([0.0])), [Walked(((0, 0),), (out,), (back,))])


def test_the_way_out_is_kept_even_where_the_way_back_is_deeper() -> None:
    table = assembled(cell(1.0, motions=11), cell(2.0, motions=22))
    assert (table.poses.proximal_mm[0, 0], table.iterations[0, 0]) == (1.0, 11)


def test_the_way_back_steps_in_only_where_the_way_out_found_nothing() -> None:
    failed = failed_cell(Status.SLID_OFF, 9)
    for table in (assembled(cell(1.0), failed), assembled(failed, cell(1.0))):
        assert table.poses.status[0, 0] == Status.OK
        assert table.poses.proximal_mm[0, 0] == 1.0
        assert np.isnan(table.hysteresis_mm[0, 0])


def test_two_failed_passes_leave_the_status_of_the_way_out_and_nothing_else() -> None:
    table = assembled(failed_cell(Status.ROTATION_BOUND, 9), failed_cell(Status.NO_CONTACT, 5))
    assert table.poses.status[0, 0] == Status.ROTATION_BOUND
    assert table.iterations[0, 0] == 9
    for name in ("lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg", "medial_gap_mm"):
        assert np.isnan(getattr(table.poses, name)[0, 0])
    assert np.isnan([table.gap_before_mm[0, 0], table.gap_after_mm[0, 0], table.hysteresis_deg[0, 0]]).all()


def test_hysteresis_is_what_the_passes_differ_by() -> None:
    table = assembled(cell(1.0, x=0.3, theta=0.02), cell(1.4, x=0.0, theta=-0.01))
    assert table.hysteresis_mm[0, 0] == pytest.approx(0.5)
    assert table.hysteresis_deg[0, 0] == pytest.approx(np.degrees(0.03))


def test_cells_go_to_their_place_in_whatever_order_walks_come() -> None:
    grid = Grid(np.array([0.0, 10.0, 20.0]), np.array([-1.0, 1.0]))
    walks = [
        Walked(cells, tuple(cell(10.0 * row + column) for row, column in cells), tuple(cell(0.0) for _ in cells))
        for cells in (((1, 1), (2, 1)), ((1, 0),), ((0, 1),), ((0, 0),), ((2, 0),))
    ]
    for order in (walks, walks[::-1]):
        np.testing.assert_array_equal(assemble(grid, order).poses.proximal_mm, [[0, 1], [10, 11], [20, 21]])


def test_a_table_holds_every_measure_in_its_unit() -> None:
    table = pose_table([[cell(1.0, x=2.0, theta=np.pi / 6.0)], [failed_cell(Status.NOT_CONVERGED)]])
    assert table.internal_rotation_deg[0, 0] == pytest.approx(30.0)
    assert (table.lateral_mm[0, 0], table.medial_gap_mm[0, 0], table.lateral_gap_mm[0, 0]) == (2.0, 0.1, 0.2)
    assert (table.equilibrium_residual[0, 0], table.contact_count[0, 0]) == (0.01, 3)
    np.testing.assert_array_equal(table.status, [[Status.OK], [Status.NOT_CONVERGED]])
    assert table.status.dtype == np.uint8


# --- a whole sweep


@pytest.fixture(scope="module")
def swept() -> RawTable:
    """A ball in a hollow sphere about the middle of the flexion axis: every attitude sees the same joint."""
    bodies = hollow_pair().bodies()
    grid = Grid(np.array([0.0, 15.0, 30.0]), np.array([-5.0, 0.0, 5.0]))
    along = [go(bodies, walk, SETTINGS) for walk in spine(grid, 14.0, 1.0, SCAN)]
    return assemble(grid, [*along, *(go(bodies, walk, SETTINGS) for walk in ribs(grid, along, SCAN))])


def test_the_answer_is_the_same_at_every_attitude(swept: RawTable) -> None:
    np.testing.assert_array_equal(swept.poses.status, Status.OK)
    np.testing.assert_allclose(swept.poses.proximal_mm, REST_MM, rtol=0, atol=FACETS_MM)
    np.testing.assert_allclose(np.hypot(swept.poses.lateral_mm, swept.poses.anterior_mm), 0.0, atol=PLACE_MM)
    np.testing.assert_array_less(swept.poses.equilibrium_residual, 0.05)


def test_every_cell_is_proven_on_both_sides(swept: RawTable) -> None:
    np.testing.assert_array_equal(swept.gap_before_mm, 0.0)
    np.testing.assert_array_less(swept.gap_after_mm, 2.1e-4)
    assert np.all(swept.iterations > 0)
    assert np.all(swept.poses.contact_count > 0)


def test_both_ways_through_the_sweep_agree_within_the_facets(swept: RawTable) -> None:
    np.testing.assert_array_less(swept.hysteresis_mm, 2.0 * PLACE_MM)


@pytest.mark.parametrize("away", [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, -2.0, 0.05)])
def test_a_body_let_go_beside_the_scan_comes_to_rest_in_the_same_place(away: tuple[float, float, float]) -> None:
    stable = let_go(hollow_pair().bodies(), Release(8.0, 1.0, SCAN, away), SETTINGS)
    assert stable.status is Status.OK
    assert stable.pose.z == pytest.approx(REST_MM, abs=FACETS_MM)
    assert np.hypot(stable.pose.x, stable.pose.y) < PLACE_MM
