"""Stage 60 on a joint with the same answer at every attitude, and the limits of its settings."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.artifacts import (
    ANATOMY,
    LIGAMENTS,
    MOVING_BODY,
    NEUTRAL_CURVE,
    RAW_TABLE,
    REFERENCE_BODY,
    SCAN_RETURNS,
    SWEEP_FACTS,
)
from pipeline.engine.artifacts import Artifact
from pipeline.engine.stage import Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.geometry.mesh import TriangleMesh, merged, transformed
from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids, ValidationPair, dish
from pipeline.kinematics.joint_coordinates import rigid
from pipeline.kinematics.sweep import Found, Place
from pipeline.kinematics.table import Status
from pipeline.records import CrossCheck, JumpCount, LigamentFibre
from pipeline.stages.sweep import STAGE, Params
from tests.geometry.knees import about
from tests.kinematics.hollow_joint import FACETS_MM, HOLLOW_MM, PLACE_MM, REST_MM, ball, hollow
from tests.kinematics.shapes import shifted, turned_down
from tests.stages.in_memory import Run, anatomy, scanned

SCAN_FROM_REFERENCE = rigid(about(15.0, -5.0, 175.0), np.array([40.0, -30.0, 700.0]))
ATTITUDE = (8.0, 1.0, 0.0, 0.4, -0.2, 5.5)
SCAN_FROM_MOVING = scanned(SCAN_FROM_REFERENCE, ATTITUDE)
#: Six attitudes, few motions; nothing solved twice.
SMALL: dict[str, Any] = {
    "flexion_max_deg": 10.0,
    "flexion_step_deg": 10.0,
    "varus_min_deg": 0.0,
    "varus_max_deg": 2.0,
    "varus_step_deg": 1.0,
    "contact_band_mm": 0.01,
    "translation_resolution_mm": 0.2,
    "rotation_step_deg": 10.0,
    "rotation_resolution_deg": 2.0,
    "cross_check_fraction": 0.0,
    "scan_shift_mm": 1.0,
    "eminence_mm": 1.0,
}
#: Every attitude solved by the other solver too; a hundredth of a millimetre is a jump.
CHECKED = {"cross_check_fraction": 1.0, "jump_mm": 0.01}
SOLVERS = ("direct", "incremental")
ARTIFACTS: tuple[Artifact[Any], ...] = (RAW_TABLE, SCAN_RETURNS, NEUTRAL_CURVE, SWEEP_FACTS)


def inputs(moving: TriangleMesh) -> dict[str, Any]:
    """The joint as it was scanned."""
    return {
        REFERENCE_BODY.name: transformed(hollow(), SCAN_FROM_REFERENCE),
        MOVING_BODY.name: transformed(moving, SCAN_FROM_MOVING),
        ANATOMY.name: anatomy(SCAN_FROM_REFERENCE, SCAN_FROM_MOVING, ATTITUDE),
        LIGAMENTS.name: (),
    }


def swept_with(**settings: Any) -> tuple[Run, Findings]:
    run = Run(STAGE, inputs(ball()), jobs=settings.pop("jobs", 1))
    return run, run.go(Params(**{**SMALL, **settings}))


@pytest.fixture(scope="module", params=SOLVERS)
def swept(request: pytest.FixtureRequest) -> tuple[Run, Findings]:
    return swept_with(solver=request.param)


@pytest.fixture(scope="module")
def checked() -> tuple[Run, Findings]:
    return swept_with(**CHECKED)


def test_every_attitude_has_the_stable_pose_of_the_joint(swept: tuple[Run, Findings]) -> None:
    table = swept[0][RAW_TABLE]
    np.testing.assert_array_equal(table.grid.flexion_deg, [0.0, 10.0])
    np.testing.assert_array_equal(table.grid.varus_deg, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(table.poses.status, Status.OK)
    np.testing.assert_allclose(table.poses.proximal_mm, REST_MM, rtol=0, atol=FACETS_MM)
    np.testing.assert_array_less(np.hypot(table.poses.lateral_mm, table.poses.anterior_mm), PLACE_MM)
    np.testing.assert_array_equal(table.gap_before_mm, 0.0)
    np.testing.assert_array_less(table.gap_after_mm, 2.1e-4)


def test_hysteresis_is_known_at_the_varus_of_the_scan(swept: tuple[Run, Findings]) -> None:
    table = swept[0][RAW_TABLE]
    for values in (table.hysteresis_mm, table.hysteresis_deg):
        np.testing.assert_array_equal(np.isfinite(values), [[False, True, False]] * 2)
    np.testing.assert_array_less(table.hysteresis_mm[:, 1], 2.0 * PLACE_MM)


def test_margins_are_known_to_the_direct_solver_only(swept: tuple[Run, Findings]) -> None:
    table, facts = swept[0][RAW_TABLE], swept[0][SWEEP_FACTS]
    for margin in (table.margin_lateral_mm, table.margin_anterior_mm, table.margin_rotation_deg):
        assert np.isfinite(margin).all() == (facts.solver == "direct")


def test_the_body_returns_to_one_place_from_nine_starts_about_the_scan(swept: tuple[Run, Findings]) -> None:
    returns = swept[0][SCAN_RETURNS]
    starts = [(one.start_lateral_mm, one.start_anterior_mm, round(one.start_rotation_deg, 9)) for one in returns]
    straight = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 3), (-1, 0, 0), (0, -1, 0), (0, 0, -3)]
    assert starts == [*straight, (0.75, 0.75, 3), (-0.75, 0.75, -3)]
    for one in returns:
        assert one.settled
        # the scan lies 0.45 mm beside the place of rest and 0.5 mm before it
        assert one.shift_mm == pytest.approx(np.hypot(0.4, 0.2), abs=PLACE_MM)
        assert one.sinking_mm == pytest.approx(REST_MM - 5.5, abs=FACETS_MM)


def test_neutral_varus_is_looked_for_at_every_flexion(swept: tuple[Run, Findings]) -> None:
    """A ball is even to both sides at every varus: what is found is in the table's range and even to the facets."""
    table, curve = swept[0][RAW_TABLE], swept[0][NEUTRAL_CURVE]
    np.testing.assert_array_equal(curve.flexion_deg, table.grid.flexion_deg)
    uneven = table.poses.lateral_gap_mm - table.poses.medial_gap_mm
    bracketed = (uneven[:, :-1] * uneven[:, 1:] <= 0.0).any(axis=1)
    np.testing.assert_array_equal(curve.status, np.where(bracketed, Status.OK, Status.NO_CONTACT))
    assert bracketed.any()
    found = curve.varus_deg[bracketed]
    assert np.all((found >= 0.0) & (found <= 2.0))
    np.testing.assert_allclose(curve.proximal_mm[bracketed], REST_MM, rtol=0, atol=FACETS_MM)


def test_progress_counts_cells_and_those_of_the_way_back_up_to_all_of_them(swept: tuple[Run, Findings]) -> None:
    told = swept[0].told
    assert [total for _, total in told] == [6 + 2] * len(told)
    done = [count for count, _ in told]
    assert done == sorted(done)
    assert done[-1] == 6 + 2


def test_a_full_table_without_jumps_is_only_noted(swept: tuple[Run, Findings]) -> None:
    run, findings = swept
    assert [(one.code, one.message) for one in findings] == [("N-SWP-01", "6 attitudes (stable pose found: 6).")]
    facts = run[SWEEP_FACTS]
    assert facts.jumps_before.count == facts.jumps_after.count == 0
    assert 0.0 < facts.jumps_after.largest_mm < 2.0 * PLACE_MM
    assert facts.cross_check == CrossCheck(0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0)
    assert facts.baselines == ()


def test_the_solvers_are_compared_where_that_is_asked_for(checked: tuple[Run, Findings]) -> None:
    check = checked[0][SWEEP_FACTS].cross_check
    assert check.cells == 6
    assert 0 < check.agreeing <= 6
    # where they choose other places on the facets, they are equally deep
    assert 0.0 < check.shift_mm < 2.0 * PLACE_MM
    assert check.shallower == 0
    assert max(check.deeper_mm, check.shallower_mm) < 0.1 * FACETS_MM
    (said,) = [one for one in checked[1] if one.code == "N-SWP-03"]
    assert said.severity is Severity.NOTE
    assert said.message.startswith(f"6 attitudes solved by the other solver too: {check.agreeing} agree ")


def test_each_attitude_that_both_solvers_solved_is_kept(checked: tuple[Run, Findings]) -> None:
    check = checked[0][SWEEP_FACTS].cross_check
    places = [(one.flexion_deg, one.varus_deg) for one in check.attitudes]
    assert places == [(flexion, varus) for flexion in (0.0, 10.0) for varus in (0.0, 1.0, 2.0)]
    assert max(one.shift_mm for one in check.attitudes) == pytest.approx(check.shift_mm, abs=1e-6)
    assert max(one.rotation_deg for one in check.attitudes) == pytest.approx(check.rotation_deg, abs=1e-6)


def test_baselines_keep_their_way_to_contact_at_each_flexion() -> None:
    run, findings = swept_with(baselines=True)
    hinge, walker = run[SWEEP_FACTS].baselines
    assert [(one.name, one.flexion_deg) for one in (hinge, walker)] == [("hinge", (0.0, 10.0)), ("walker", (0.0, 10.0))]
    # the scan lies beside the place of rest and before it: the way is that of a ball in a bowl, at every flexion
    way = np.sqrt(REST_MM**2 - 0.4**2 - 0.2**2) - 5.5
    np.testing.assert_allclose(hinge.way_mm, way, rtol=0, atol=2.0 * FACETS_MM)
    assert walker.way_mm[0] > hinge.way_mm[0] + 0.2
    (said,) = [one for one in findings if one.code == "N-SWP-04"]
    assert (
        f"a plain hinge about the flexion axis would overlap by up to 0.0 mm and gape by up to {way:.1f} mm;"
        in said.message
    )


@pytest.mark.parametrize(("fraction", "cells"), [(0.5, 3), (0.2, 1), (0.05, 0)])
def test_a_fraction_of_the_attitudes_is_compared(fraction: float, cells: int) -> None:
    assert swept_with(cross_check_fraction=fraction)[0][SWEEP_FACTS].cross_check.cells == cells


def test_the_papers_solver_is_compared_with_the_direct_one() -> None:
    facts = swept_with(cross_check_fraction=1.0, solver="incremental")[0][SWEEP_FACTS]
    assert (facts.solver, facts.cross_check.cells, facts.cross_check.shallower) == ("incremental", 6, 0)
    assert facts.cross_check.shift_mm < 2.0 * PLACE_MM


def test_jumps_are_counted_and_said(checked: tuple[Run, Findings]) -> None:
    facts = checked[0][SWEEP_FACTS]
    assert facts.jumps_before.count > 0
    assert facts.jumps_after.count <= facts.jumps_before.count
    (said,) = [one for one in checked[1] if one.code == "N-SWP-02"]
    assert said.severity is Severity.NOTE
    counts = f"{facts.jumps_before.count} jumps between neighbouring attitudes, {facts.jumps_after.count} after"
    assert said.message.startswith(counts)


def test_what_was_solved_again_is_kept_and_counted_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Solving again is made to bring every attitude to one pose."""
    rounds: list[int] = []

    def alike(found: dict[Place, Found], _todo: object, _solve: object, count: int) -> dict[Place, Found]:
        rounds.append(count)
        return dict.fromkeys(found, found[(0, 1)])

    monkeypatch.setattr("pipeline.stages.sweep.mended", alike)
    run, _ = swept_with(jump_mm=0.01, jump_rounds=3)
    facts, table = run[SWEEP_FACTS], run[RAW_TABLE]
    assert rounds == [3]
    assert facts.jumps_before.count > 0
    assert facts.jumps_after == JumpCount(0, 0.0, 0.0)
    assert np.ptp(table.poses.lateral_mm) == 0.0


def test_checking_does_not_change_the_table(checked: tuple[Run, Findings]) -> None:
    plain = swept_with(jump_mm=0.01)[0]
    for artifact in ARTIFACTS[:3]:
        assert artifact.encode(plain[artifact]) == artifact.encode(checked[0][artifact])


def test_two_jobs_give_the_same_bytes(checked: tuple[Run, Findings]) -> None:
    """Threads for the direct solver, processes for the other one and for the proofs."""
    run, findings = swept_with(jobs=2, **CHECKED)
    assert findings == checked[1]
    for artifact in ARTIFACTS:
        assert artifact.encode(run[artifact]) == artifact.encode(checked[0][artifact])


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_joint_without_any_stable_pose_is_refused(solver: str) -> None:
    """A ball that starts 200 mm beside the joint meets nothing."""
    run = Run(STAGE, inputs(shifted(ball(), x=200.0)))
    with pytest.raises(CaseRejected, match=r"E-SWP-01 No stable pose at any of 2 flexions .*no contact: 2"):
        run.go(Params(**{**SMALL, "solver": solver}))
    assert run.left == {}


@pytest.mark.parametrize("solver", SOLVERS)
def test_bounds_are_about_the_scan(solver: str) -> None:
    """The place of rest is 0.45 mm beside the scan."""
    with pytest.raises(CaseRejected, match=r"E-SWP-01 .* \(slid off: 2"):
        swept_with(solver=solver, slide_bound_mm=0.2)
    swept_with(solver=solver, slide_bound_mm=0.45 + PLACE_MM)


@pytest.mark.parametrize(
    ("scanned_deg", "most_deg", "begun_deg"), [(40, 180, 40), (40, 12, 12), (-40, 12, -12), (9, 12, 9)]
)
def test_a_twisted_scan_begins_as_a_joint_at_rest(scanned_deg: float, most_deg: float, begun_deg: float) -> None:
    """A ball turns freely, so it keeps the rotation that it began with."""
    attitude = (8.0, 1.0, float(scanned_deg), 0.4, -0.2, 5.5)
    moving = scanned(SCAN_FROM_REFERENCE, attitude)
    given = inputs(ball()) | {
        MOVING_BODY.name: transformed(ball(), moving),
        ANATOMY.name: anatomy(SCAN_FROM_REFERENCE, moving, attitude),
    }
    run = Run(STAGE, given)
    run.go(Params(**{**SMALL, "rest_rotation_deg": float(most_deg)}))
    np.testing.assert_allclose(run[RAW_TABLE].poses.internal_rotation_deg, begun_deg, atol=6.0)


PAPER: dict[str, Any] = {
    "flexion_max_deg": 0.0,
    "varus_min_deg": 0.0,
    "varus_max_deg": 0.0,
    "translation_resolution_mm": 0.02,
    "contact_band_mm": 2e-3,
}


def let_go(pair: ValidationPair) -> dict[str, Any]:
    """A test object of the paper where it is let go: nothing flexed, nothing in varus."""
    found = np.linalg.inv(pair.scan_from_reference) @ pair.scan_from_moving
    turn = float(np.degrees(np.arctan2(found[1, 0], found[0, 0])))
    x, y, z = found[:3, 3].tolist()
    return {
        REFERENCE_BODY.name: merged(list(pair.reference.values())),
        MOVING_BODY.name: merged(list(pair.moving.values())),
        ANATOMY.name: anatomy(pair.scan_from_reference, pair.scan_from_moving, (0.0, 0.0, turn, x, y, z)),
        LIGAMENTS.name: (),
    }


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("pair", [BallInDish().pair(), BarOnPyramids().pair()], ids=["ball", "bar"])
def test_the_papers_objects_come_to_rest_where_they_must(pair: ValidationPair, solver: str) -> None:
    run = Run(STAGE, let_go(pair))
    run.go(Params(**{**PAPER, "solver": solver, "cross_check_fraction": 1.0}))
    poses = run[RAW_TABLE].poses
    for field in fields(pair.rest):
        expected = getattr(pair.rest, field.name)
        if expected is not None:
            assert getattr(poses, field.name)[0, 0] == pytest.approx(expected, abs=0.03), field.name
    assert run[SWEEP_FACTS].cross_check.cells == 1
    assert run[NEUTRAL_CURVE].status[0] == Status.NO_CONTACT


def test_a_body_that_has_nothing_to_touch_with_on_one_side_has_no_neutral_varus() -> None:
    """The bar's faces have their middles within the eminence, and still it touches on either side of it."""
    run = Run(STAGE, let_go(BarOnPyramids().pair()))
    run.go(Params(**{**PAPER, "varus_min_deg": -1.0, "varus_max_deg": 1.0}))
    uneven = run[RAW_TABLE].poses.lateral_gap_mm - run[RAW_TABLE].poses.medial_gap_mm
    assert uneven[0, 0] * uneven[0, -1] < 0.0
    np.testing.assert_array_equal(run[NEUTRAL_CURVE].status, [Status.NO_CONTACT])


def test_attitudes_that_failed_ask_for_review() -> None:
    """An open dish about the same middle: flexed by 80 degrees it does not hold the ball."""
    given = inputs(ball())
    cup = shifted(turned_down(dish(HOLLOW_MM)), z=HOLLOW_MM)
    given[REFERENCE_BODY.name] = transformed(cup, SCAN_FROM_REFERENCE)
    run = Run(STAGE, given)
    findings = run.go(Params(**{**SMALL, "flexion_max_deg": 80.0, "flexion_step_deg": 80.0}))
    status = run[RAW_TABLE].poses.status
    np.testing.assert_array_equal(status[0], Status.OK)
    np.testing.assert_array_equal(status[1], Status.SLID_OFF)
    np.testing.assert_array_equal(np.isnan(run[RAW_TABLE].poses.proximal_mm), status != Status.OK)
    assert [one.severity for one in findings] == [Severity.NOTE, Severity.REVIEW]
    assert findings[1].message == "3 of 6 attitudes have no stable pose (slid off: 3)."


# --- ligaments


def spring(aside_mm: float) -> LigamentFibre:
    """From the ball's centre to a point of the flexion axis: 0.1 N a mm beyond a length of 1 mm."""
    x, y, z = (SCAN_FROM_REFERENCE @ [aside_mm, 0.0, 0.0, 1.0])[:3].tolist()
    u, v, w = SCAN_FROM_MOVING[:3, 3].tolist()
    return LigamentFibre("spring", (x, y, z), (u, v, w), slack_mm=1.0, stiffness_n=0.1)


def pulled(aside_mm: float, **settings: Any) -> Run:
    run = Run(STAGE, {**inputs(ball()), LIGAMENTS.name: (spring(aside_mm),)})
    run.go(Params(**{**SMALL, "flexion_max_deg": 0.0, "varus_max_deg": 0.0, **settings}))
    return run


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("aside_mm", [40.0, -40.0])
def test_a_spring_draws_the_ball_up_its_bowl_until_push_and_pull_are_balanced(solver: str, aside_mm: float) -> None:
    """About the bowl's middle the push has the lever x, the pull k (length - 1) the lever of a line through its end."""
    poses = pulled(aside_mm, ligaments=True, push_n=8.0, solver=solver)[RAW_TABLE].poses
    assert poses.equilibrium_residual[0, 0] < 0.01
    x, z = poses.lateral_mm[0, 0], poses.proximal_mm[0, 0]
    length = np.hypot(aside_mm - x, z)
    assert 8.0 * x == pytest.approx(0.1 * (length - 1.0) * aside_mm * z / length, abs=8.0 * PLACE_MM)
    assert x * aside_mm > 0.0
    assert abs(x) > 2.0
    assert z == pytest.approx(np.sqrt(REST_MM**2 - x**2), abs=FACETS_MM)


def test_later_stages_are_told_of_the_push_that_ligaments_pulled_against() -> None:
    settings = {"push_n": 20.0, "reference_strain_fraction": 0.04}
    with_them, without = (pulled(40.0, ligaments=wanted, **settings)[SWEEP_FACTS] for wanted in (True, False))
    assert (with_them.push_n, with_them.reference_strain) == (20.0, 0.04)
    assert without.push_n == 0.0


def test_ligaments_that_are_not_asked_for_change_nothing(swept: tuple[Run, Findings]) -> None:
    solver = swept[0][SWEEP_FACTS].solver
    run = Run(STAGE, {**inputs(ball()), LIGAMENTS.name: (spring(40.0),)})
    run.go(Params(**{**SMALL, "solver": solver}))
    assert RAW_TABLE.encode(run[RAW_TABLE]) == RAW_TABLE.encode(swept[0][RAW_TABLE])


def test_ligaments_that_are_asked_for_have_to_be_there() -> None:
    with pytest.raises(CaseRejected, match="E-LIG-04 The settings ask for ligaments, and the case has none"):
        swept_with(ligaments=True)


# --- settings


def test_the_grid_includes_both_ends() -> None:
    grid = Params(flexion_min_deg=-5.0, flexion_max_deg=20.0, flexion_step_deg=2.5, varus_step_deg=5.0).grid()
    np.testing.assert_array_equal(grid.flexion_deg, np.arange(-5.0, 20.1, 2.5))
    np.testing.assert_array_equal(grid.varus_deg, [-5.0, 0.0, 5.0])


def test_the_default_grid_has_an_attitude_a_degree() -> None:
    grid = Params().grid()
    np.testing.assert_array_equal(grid.flexion_deg, np.arange(121.0))
    np.testing.assert_array_equal(grid.varus_deg, np.arange(-5.0, 6.0))


def test_one_attitude_is_a_grid() -> None:
    grid = Params(flexion_max_deg=0.0, varus_min_deg=1.0, varus_max_deg=1.0).grid()
    assert grid.shape == (1, 1)
    assert (grid.flexion_deg[0], grid.varus_deg[0]) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"flexion_step_deg": 7.0}, r"flexion_step_deg 7\.0 does not divide the range 0\.0 to 120\.0"),
        ({"varus_step_deg": 3.0}, r"varus_step_deg 3\.0 does not divide the range -5\.0 to 5\.0"),
        ({"flexion_min_deg": 50.0, "flexion_max_deg": 40.0}, r"flexion_max_deg 40\.0 is below flexion_min_deg 50\.0"),
        ({"flexion_step_deg": 0.0625, "varus_step_deg": 0.0625}, "the grid has 309281 cells, at most 100000"),
        ({"flexion_step_deg": 0.0}, "greater than 0"),
        ({"varus_min_deg": -45.0}, "greater than or equal to -30"),
        ({"solver": "newton"}, "Input should be 'direct' or 'incremental'"),
        ({"map_spacing_mm": 0.01}, r"greater than or equal to 0\.05"),
        ({"cross_check_fraction": 1.1}, "less than or equal to 1"),
        ({"jump_rounds": -1}, "greater than or equal to 0"),
        ({"jump_mm": 0.0}, "greater than 0"),
        ({"slide_bound": 3.0}, "Extra inputs are not permitted"),
    ],
)
def test_settings_that_make_no_grid_are_refused(settings: dict[str, Any], match: str) -> None:
    with pytest.raises(ValidationError, match=match):
        Params(**settings)


def test_a_hair_fine_step_is_refused_without_making_its_grid() -> None:
    with pytest.raises(ValidationError, match="the grid has 2621440625 cells, at most 100000"):
        Params(flexion_max_deg=125.0, flexion_step_deg=125.0 / 2**22, varus_step_deg=10.0 / 624.0)
