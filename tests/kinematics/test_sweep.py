"""The sweep: a spine and ribs that cover the grid, the way out kept, and a joint with the same answer everywhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest

from pipeline.kinematics.cell import Cell, Certificate, Claim, Proof, failed_cell, prove
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.incremental import StablePose
from pipeline.kinematics.solvers import NO_MARGIN, Margin, Solver
from pipeline.kinematics.sweep import (
    Certified,
    Evidence,
    Found,
    Hysteresis,
    Place,
    Release,
    Walk,
    Walked,
    Ways,
    angles_rad,
    assemble,
    attitude_deg,
    certified,
    go,
    hysteresis,
    kept,
    let_go,
    pose_table,
    ribs,
    spine,
    walk_grid,
    way_back,
)
from pipeline.kinematics.table import Grid, RawTable, Status
from tests.kinematics.hollow_joint import BALL_MM, FACETS_MM, PLACE_MM, PROOF, REST_MM, direct, hollow_pair, incremental

SCAN = Pose(0.5, -0.3, 5.0, 0.0)
GRID = Grid(np.linspace(0.0, 60.0, 7), np.array([-4.0, -2.0, 0.0, 2.0]))
ONE = Grid(np.array([0.0]), np.array([0.0]))

CERTIFICATE = Certificate(residual=0.01, contact_count=3, medial_gap_mm=0.1, lateral_gap_mm=0.2)
MARGIN = Margin(lateral_mm=2.0, anterior_mm=3.0, rotation_deg=4.0)
PROVEN = Proof(gap_before_mm=0.0, gap_after_mm=2e-4, medial_gap_mm=0.3, lateral_gap_mm=0.4)


def found(z: float, x: float = 0.0, theta: float = 0.0, motions: int = 0) -> Found:
    return Found(SCAN, StablePose(Pose(x, 0.0, z, theta), Status.OK, motions, 0))


def lost(status: Status = Status.SLID_OFF, motions: int = 0) -> Found:
    return Found(SCAN, StablePose(SCAN, status, motions, 0))


def walked(walk: Walk, failed: frozenset[int] = frozenset()) -> Walked:
    """A walk whose cells have their flexion as z; the rows in ``failed`` have slid off."""
    out = tuple(lost() if at[0] in failed else found(GRID.flexion_deg[at[0]]) for at in walk.cells)
    return Walked(walk.cells, out)


def cells_of(*walks: Walk) -> list[Place]:
    return [at for walk in walks for at in walk.cells]


# --- walks


@pytest.mark.parametrize("flexion_deg", [31.0, 0.0, 60.0, -12.0, 95.0, 4.9, 5.1])
@pytest.mark.parametrize("varus_deg", [0.3, -9.0, 2.0])
def test_spine_and_ribs_cover_every_cell_once(flexion_deg: float, varus_deg: float) -> None:
    along = spine(GRID, flexion_deg, varus_deg, SCAN)
    across = ribs(GRID, [walked(walk) for walk in along], SCAN, range(7))
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
    for walk in (*along, *ribs(GRID, [walked(one) for one in along], SCAN, range(7))):
        steps = np.abs(np.diff(walk.cells, axis=0)).sum(axis=1)
        np.testing.assert_array_equal(steps, 1)
        expected = [(GRID.flexion_deg[row], GRID.varus_deg[column]) for row, column in walk.cells]
        assert list(walk.attitudes_deg) == expected


def test_the_spine_is_walked_back_from_its_last_usable_pose() -> None:
    along = spine(GRID, 21.0, 0.0, SCAN)
    back = way_back(along, [walked(one, frozenset({6})) for one in along])
    assert [walk.cells for walk in back] == [walk.cells[::-1] for walk in along]
    assert [walk.attitudes_deg for walk in back] == [walk.attitudes_deg[::-1] for walk in along]
    assert [walk.start.z for walk in back] == [50.0, 0.0]
    (lost_way,) = way_back(along[:1], [walked(along[0], frozenset(range(7)))])
    assert lost_way.start == SCAN


@pytest.mark.parametrize("stretch", [1, 2, 24])
@pytest.mark.parametrize("failed", [frozenset[int](), frozenset({2, 3, 6}), frozenset(range(7))])
def test_a_grid_is_walked_the_same_way_by_stretches_of_any_length(
    monkeypatch: pytest.MonkeyPatch, stretch: int, failed: frozenset[int]
) -> None:
    monkeypatch.setattr("pipeline.kinematics.sweep.STRETCH", stretch)
    begun: list[Walk] = []

    def walk(walks: Sequence[Walk]) -> list[Walked]:
        begun.extend(walks)
        return [walked(one, failed) for one in walks]

    ways = walk_grid(GRID, (21.0, 0.0), SCAN, walk)
    along = spine(GRID, 21.0, 0.0, SCAN)
    whole = [walked(one, failed) for one in along]
    across = ribs(GRID, whole, SCAN, range(7))
    assert [one.cells for one in ways.out[:2]] == [one.cells for one in along]
    assert sorted(one.cells for one in ways.out[2:]) == sorted(one.cells for one in across)
    assert {one.cells: one.start for one in begun if one in across} == {one.cells: one.start for one in across}
    assert [one.cells for one in ways.back] == [one.cells[::-1] for one in along]
    assert list(way_back(along, whole)) == [one for one in begun if one in way_back(along, whole)][-2:]


def test_a_stretch_starts_where_the_one_before_it_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.kinematics.sweep.STRETCH", 2)
    solver = Deeper(failing=frozenset({2}))
    grid = Grid(np.arange(5.0), np.array([0.0]))
    ways = walk_grid(grid, (0.0, 0.0), SCAN, lambda walks: [go(solver, one) for one in walks])
    assert [one.start.z for one in ways.out[0].found] == [5.0, 6.0, 6.0, 7.0, 8.0]
    assert [one.start.z for one in ways.back[0].found] == [9.0, 10.0, 11.0, 12.0, 13.0]


def test_a_rib_starts_from_its_own_cell_of_the_spine_and_is_bound_about_the_scan() -> None:
    along = spine(GRID, 21.0, 0.0, SCAN)
    for walk in ribs(GRID, [walked(one) for one in along], SCAN, range(7)):
        assert walk.start.z == GRID.flexion_deg[walk.cells[0][0]]
        assert walk.cells[0][1] in (1, 3)
        assert walk.centre == SCAN


def test_a_rib_of_a_failed_cell_starts_from_the_nearest_row_that_did_not_fail() -> None:
    along = spine(GRID, 21.0, 0.0, SCAN)
    across = ribs(GRID, [walked(one, frozenset({0, 1, 4})) for one in along], SCAN, range(7))
    starts = {walk.cells[0][0]: walk.start.z for walk in across}
    assert starts == {0: 20.0, 1: 20.0, 2: 20.0, 3: 30.0, 4: 30.0, 5: 50.0, 6: 60.0}


def test_without_a_spine_there_are_no_ribs_and_their_cells_stay_unreached() -> None:
    along = spine(GRID, 21.0, 0.0, SCAN)
    nothing = [walked(one, frozenset(range(7))) for one in along]
    assert ribs(GRID, nothing, SCAN, range(7)) == ()
    status = assembled(GRID, kept(Ways(tuple(nothing), ()))).poses.status
    np.testing.assert_array_equal(status[:, 2], Status.SLID_OFF)
    np.testing.assert_array_equal(status[:, [0, 1, 3]], Status.NOT_CONVERGED)


def test_a_grid_of_one_attitude_is_one_walk() -> None:
    grid = Grid(np.array([30.0]), np.array([1.0]))
    along = spine(grid, 8.0, -3.0, SCAN)
    assert [walk.cells for walk in along] == [((0, 0),)]
    assert ribs(grid, [Walked(along[0].cells, (found(1.0),))], SCAN, [0]) == ()


def test_attitudes_are_those_of_the_grid() -> None:
    assert attitude_deg(GRID, (2, 1)) == (20.0, -2.0)
    assert angles_rad((180.0, -90.0)) == (np.pi, -np.pi / 2.0)


# --- walking


@dataclass
class Deeper:
    """A solver whose every search ends 1 mm deeper than it began; the searches numbered in ``failing`` slide off."""

    failing: frozenset[int] = frozenset()
    asked: list[tuple[tuple[float, float], Pose, Pose]] = field(default_factory=list)

    def at(self, angles: tuple[float, float]) -> DeeperAttitude:
        return DeeperAttitude(self, angles)


@dataclass
class DeeperAttitude:
    solver: Deeper
    angles: tuple[float, float]

    def solve(self, start: Pose, centre: Pose) -> StablePose:
        self.solver.asked.append((self.angles, start, centre))
        count = len(self.solver.asked)
        status = Status.SLID_OFF if count in self.solver.failing else Status.OK
        return StablePose(start._replace(z=start.z + 1.0), status, count, 0)

    def certify(self, pose: Pose) -> Certificate:
        return CERTIFICATE._replace(residual=pose.z)

    def margin(self, pose: Pose) -> Margin:
        return Margin(pose.x, pose.y, float(np.degrees(self.angles[0])))


def walk_of(rows: int) -> Walk:
    """Down the first column in steps of 10 degrees, from z = 0."""
    cells = tuple((row, 0) for row in range(rows))
    attitudes = tuple((10.0 * row, -1.0) for row in range(rows))
    return Walk(cells, attitudes, Pose(0.0, 0.0, 0.0, 0.0), SCAN)


def test_a_walk_goes_on_from_the_last_usable_pose() -> None:
    solver = Deeper(failing=frozenset({3}))
    result = go(solver, walk_of(4))
    assert [start.z for _, start, _ in solver.asked] == [0, 1, 2, 2]
    assert [one.start.z for one in result.found] == [0, 1, 2, 2]
    assert [one.stable.pose.z for one in result.found if one.stable.status.usable] == [1, 2, 3]
    assert result.found[2].stable.status is Status.SLID_OFF


def test_a_walk_is_solved_at_its_attitudes_and_bound_about_its_centre() -> None:
    solver = Deeper()
    go(solver, walk_of(3))
    assert [angles for angles, _, _ in solver.asked] == [angles_rad((flexion, -1.0)) for flexion in (0.0, 10.0, 20.0)]
    assert {centre for _, _, centre in solver.asked} == {SCAN}


def test_a_body_is_let_go_beside_the_scan_and_bound_about_it() -> None:
    solver = Deeper()
    stable = let_go(solver, Release(8.0, 1.0, SCAN._replace(theta=0.1), (1.0, -2.0, 0.05)))
    ((angles, start, centre),) = solver.asked
    assert angles == angles_rad((8.0, 1.0))
    assert start == pytest.approx((1.5, -2.3, 5.0, 0.15))
    assert centre == SCAN._replace(theta=0.1)
    assert stable.pose.z == 6.0


def test_a_pose_is_certified_at_its_attitude() -> None:
    known = certified(Deeper(), ((30.0, 2.0), Pose(0.1, 0.2, 0.3, 0.0)))
    assert known.certificate.residual == 0.3
    assert known.margin == pytest.approx((0.1, 0.2, 30.0))


# --- what is kept


def one_cell(out: Found, *back: Found) -> Ways:
    return Ways((Walked(((0, 0),), (out,)),), tuple(Walked(((0, 0),), (one,)) for one in back))


def keep(out: Found, *back: Found) -> Found:
    return kept(one_cell(out, *back))[(0, 0)]


def test_the_way_out_is_kept_even_where_the_way_back_is_deeper() -> None:
    assert keep(found(1.0, motions=11), found(2.0, motions=22)) == found(1.0, motions=11)


def test_the_way_back_steps_in_only_where_the_way_out_found_nothing() -> None:
    assert keep(lost(motions=9), found(1.0)) == found(1.0)
    assert keep(found(1.0), lost(motions=9)) == found(1.0)


def test_two_failed_passes_leave_what_the_way_out_says() -> None:
    out = lost(Status.ROTATION_BOUND, 9)
    assert keep(out, lost(Status.NO_CONTACT, 5)) == out
    assert keep(out) == out


def test_a_pose_of_one_walk_is_not_replaced_by_another_walks_failure() -> None:
    spine_cells, rib = ((0, 0), (1, 0)), Walked(((0, 1),), (lost(),))
    ways = Ways((Walked(spine_cells, (found(1.0), lost())), rib), (Walked(spine_cells[::-1], (found(4.0), lost())),))
    assert {at: one.stable.pose.z for at, one in kept(ways).items() if one.stable.status.usable} == {
        (0, 0): 1.0,
        (1, 0): 4.0,
    }


def difference(out: Found, *back: Found) -> tuple[float, float]:
    passes = hysteresis(ONE, one_cell(out, *back))
    return float(passes.shift_mm[0, 0]), float(passes.rotation_deg[0, 0])


def test_hysteresis_is_what_the_passes_differ_by() -> None:
    differ = difference(found(1.0, x=0.3, theta=0.02), found(1.4, x=0.0, theta=-0.01))
    assert differ == pytest.approx((0.5, np.degrees(0.03)))


def test_there_is_no_hysteresis_where_a_pass_failed_or_was_not_made() -> None:
    for passes in ((found(1.0), lost()), (lost(), found(1.0)), (found(1.0),), (lost(), lost())):
        assert np.isnan(difference(*passes)).all()


def test_hysteresis_is_known_only_along_the_spine() -> None:
    along = spine(GRID, 21.0, 0.0, SCAN)
    out = [walked(one, frozenset({4})) for one in along]
    back = [Walked(one.cells[::-1], one.found[::-1]) for one in out]
    across = [walked(one) for one in ribs(GRID, out, SCAN, range(7))]
    known = np.isfinite(hysteresis(GRID, Ways((*out, *across), tuple(back))).shift_mm)
    np.testing.assert_array_equal(np.argwhere(known), [(row, 2) for row in range(7) if row != 4])


# --- assembling


def assembled(grid: Grid, cells: dict[Place, Found], passes: Hysteresis | None = None) -> RawTable:
    """A table whose usable cells are all certified and proven alike."""
    usable = [at for at, one in cells.items() if one.stable.status.usable]
    evidence = Evidence(dict.fromkeys(usable, Certified(CERTIFICATE, MARGIN)), dict.fromkeys(usable, PROVEN))
    return assemble(grid, cells, evidence, passes or hysteresis(grid, Ways((), ())))


def test_a_usable_cell_holds_all_that_is_known_of_it() -> None:
    table = assembled(ONE, {(0, 0): found(1.0, x=2.0, motions=7)}, Hysteresis(np.array([[0.5]]), np.array([[0.6]])))
    poses = table.poses
    assert (poses.proximal_mm[0, 0], poses.lateral_mm[0, 0], table.iterations[0, 0]) == (1.0, 2.0, 7)
    assert (poses.equilibrium_residual[0, 0], poses.contact_count[0, 0]) == (0.01, 3)
    # the proof measured the compartments, the certificate only what is in contact
    assert (poses.medial_gap_mm[0, 0], poses.lateral_gap_mm[0, 0]) == (0.3, 0.4)
    assert (table.gap_before_mm[0, 0], table.gap_after_mm[0, 0]) == (0.0, 2e-4)
    assert (table.hysteresis_mm[0, 0], table.hysteresis_deg[0, 0]) == (0.5, 0.6)
    margins = table.margin_lateral_mm, table.margin_anterior_mm, table.margin_rotation_deg
    assert [float(one[0, 0]) for one in margins] == list(MARGIN)


def test_a_failed_cell_leaves_its_status_and_nothing_else() -> None:
    table = assembled(ONE, {(0, 0): lost(Status.ROTATION_BOUND, 9)})
    assert table.poses.status[0, 0] == Status.ROTATION_BOUND
    assert table.iterations[0, 0] == 9
    for name in ("lateral_mm", "anterior_mm", "proximal_mm", "internal_rotation_deg", "medial_gap_mm"):
        assert np.isnan(getattr(table.poses, name)[0, 0])
    assert np.isnan([table.gap_before_mm[0, 0], table.gap_after_mm[0, 0], table.margin_lateral_mm[0, 0]]).all()


def test_cells_go_to_their_place_in_whatever_order_walks_come() -> None:
    grid = Grid(np.array([0.0, 10.0, 20.0]), np.array([-1.0, 1.0]))
    walks = [
        Walked(cells, tuple(found(10.0 * row + column) for row, column in cells))
        for cells in (((1, 1), (2, 1)), ((1, 0),), ((0, 1),), ((0, 0),), ((2, 0),))
    ]
    for order in (walks, walks[::-1]):
        np.testing.assert_array_equal(
            assembled(grid, kept(Ways(tuple(order), ()))).poses.proximal_mm, [[0, 1], [10, 11], [20, 21]]
        )


def test_a_table_holds_every_measure_in_its_unit() -> None:
    cell = Cell(Pose(2.0, 0.0, 1.0, np.pi / 6.0), Status.SMOOTHED, 0, CERTIFICATE, PROVEN)
    table = pose_table([[cell], [failed_cell(Status.NOT_CONVERGED)]])
    assert table.internal_rotation_deg[0, 0] == pytest.approx(30.0)
    assert (table.lateral_mm[0, 0], table.medial_gap_mm[0, 0], table.lateral_gap_mm[0, 0]) == (2.0, 0.3, 0.4)
    assert (table.equilibrium_residual[0, 0], table.contact_count[0, 0]) == (0.01, 3)
    np.testing.assert_array_equal(table.status, [[Status.SMOOTHED], [Status.NOT_CONVERGED]])
    assert table.status.dtype == np.uint8


# --- a whole sweep


SOLVERS: dict[str, Callable[[], Solver]] = {"direct": direct, "incremental": incremental}


@pytest.fixture(scope="module", params=list(SOLVERS))
def solver(request: pytest.FixtureRequest) -> Solver:
    return SOLVERS[request.param]()


@pytest.fixture(scope="module")
def swept(solver: Solver) -> RawTable:
    """A ball in a bowl about the middle of the flexion axis: every attitude sees the same joint."""
    grid = Grid(np.array([0.0, 15.0, 30.0]), np.array([-5.0, 0.0, 5.0]))
    ways = walk_grid(grid, (14.0, 1.0), SCAN, lambda walks: [go(solver, walk) for walk in walks])
    poses = {at: one.stable.pose for at, one in kept(ways).items()}
    known = {at: certified(solver, (attitude_deg(grid, at), pose)) for at, pose in poses.items()}
    claims = {at: Claim(angles_rad(attitude_deg(grid, at)), poses[at], one.certificate) for at, one in known.items()}
    bodies = hollow_pair().bodies()
    proofs = {at: prove(bodies, claim, PROOF.ladder_mm) for at, claim in claims.items()}
    return assemble(grid, kept(ways), Evidence(known, proofs), hysteresis(grid, ways))


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
    np.testing.assert_array_less(swept.hysteresis_mm[:, 1], 2.0 * PLACE_MM)
    assert np.isnan(swept.hysteresis_mm[:, [0, 2]]).all()


@pytest.mark.parametrize("away", [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, -2.0, 0.05)])
def test_a_body_let_go_beside_the_scan_comes_to_rest_in_the_same_place(
    solver: Solver, away: tuple[float, float, float]
) -> None:
    stable = let_go(solver, Release(8.0, 1.0, SCAN, away))
    assert stable.status is Status.OK
    assert stable.pose.z == pytest.approx(REST_MM, abs=FACETS_MM)
    assert np.hypot(stable.pose.x, stable.pose.y) < PLACE_MM


def test_a_ball_is_held_by_its_bowl_to_every_side() -> None:
    """Pushed by 5 mm, the most that is looked at, it still goes on down: the wall is 6 mm away."""
    known = certified(direct(), ((10.0, 2.0), Pose(0.0, 0.0, REST_MM - 1e-3, 0.0)))
    assert known.margin.lateral_mm == known.margin.anterior_mm == 5.0
    assert known.certificate.contact_count >= 1
    assert np.isinf([known.certificate.medial_gap_mm, known.certificate.lateral_gap_mm]).all()


def test_the_paper_s_solver_does_not_know_the_margin() -> None:
    pose = Pose(0.0, 0.0, REST_MM - 1e-3, 0.0)
    known = certified(incremental(), ((10.0, 2.0), pose))
    np.testing.assert_array_equal(known.margin, NO_MARGIN)
    assert known.certificate.contact_count >= 1


def test_a_ball_on_the_wall_is_certified_to_leave_the_sine_of_its_slope(solver: Solver) -> None:
    """4 mm beside the middle, the line to it leans by asin(4 / 6): no reaction of the wall can balance that."""
    pose = direct().at(angles_rad((10.0, 2.0))).depth(Pose(4.0, 0.0, 3.0, 0.0))
    assert pose is not None
    known = certified(solver, ((10.0, 2.0), pose))
    # within the band lie features up to 0.5 mm lower on the ball, whose normals lean less by 0.5 / 6
    assert known.certificate.residual == pytest.approx(4.0 / REST_MM, abs=0.5 / BALL_MM)
    assert known.certificate.lateral_gap_mm < PROOF.contact_band_mm
    assert np.isinf(known.certificate.medial_gap_mm)
