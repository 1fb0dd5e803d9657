"""Stage 60 on a joint with the same answer at every attitude, and the limits of its settings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.artifacts import ANATOMY, MOVING_BODY, RAW_TABLE, REFERENCE_BODY, SCAN_RETURNS
from pipeline.engine.stage import Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.geometry.mesh import TriangleMesh, transformed
from pipeline.geometry.validation_objects import dish
from pipeline.kinematics.joint_coordinates import rigid
from pipeline.kinematics.table import Status
from pipeline.stages.sweep import STAGE, Params
from tests.geometry.knees import about
from tests.kinematics.hollow_joint import FACETS_MM, HOLLOW_MM, PLACE_MM, REST_MM, ball, hollow
from tests.kinematics.shapes import shifted, turned_down
from tests.stages.in_memory import Run, anatomy, scanned

SCAN_FROM_REFERENCE = rigid(about(15.0, -5.0, 175.0), np.array([40.0, -30.0, 700.0]))
ATTITUDE = (8.0, 1.0, 0.0, 0.4, -0.2, 5.5)
SCAN_FROM_MOVING = scanned(SCAN_FROM_REFERENCE, ATTITUDE)
#: Three attitudes, few motions.
SMALL: dict[str, Any] = {
    "flexion_max_deg": 10.0,
    "flexion_step_deg": 10.0,
    "varus_min_deg": 0.0,
    "varus_max_deg": 2.0,
    "contact_band_mm": 0.01,
    "translation_resolution_mm": 0.2,
    "rotation_step_deg": 10.0,
    "rotation_resolution_deg": 2.0,
    "scan_shift_mm": 1.0,
    "eminence_mm": 1.0,
}


def inputs(moving: TriangleMesh) -> dict[str, Any]:
    """The joint as it was scanned."""
    return {
        REFERENCE_BODY.name: transformed(hollow(), SCAN_FROM_REFERENCE),
        MOVING_BODY.name: transformed(moving, SCAN_FROM_MOVING),
        ANATOMY.name: anatomy(SCAN_FROM_REFERENCE, SCAN_FROM_MOVING, ATTITUDE),
    }


@pytest.fixture(scope="module")
def swept() -> tuple[Run, Findings]:
    run = Run(STAGE, inputs(ball()))
    return run, run.go(Params(**SMALL))


def test_every_attitude_has_the_stable_pose_of_the_joint(swept: tuple[Run, Findings]) -> None:
    table = swept[0][RAW_TABLE]
    np.testing.assert_array_equal(table.grid.flexion_deg, [0.0, 10.0])
    np.testing.assert_array_equal(table.grid.varus_deg, [0.0, 2.0])
    np.testing.assert_array_equal(table.poses.status, Status.OK)
    np.testing.assert_allclose(table.poses.proximal_mm, REST_MM, rtol=0, atol=FACETS_MM)
    np.testing.assert_array_less(np.hypot(table.poses.lateral_mm, table.poses.anterior_mm), PLACE_MM)
    np.testing.assert_array_equal(table.gap_before_mm, 0.0)
    np.testing.assert_array_less(table.gap_after_mm, 2.1e-4)


def test_the_body_returns_to_one_place_from_seven_starts_about_the_scan(swept: tuple[Run, Findings]) -> None:
    returns = swept[0][SCAN_RETURNS]
    starts = [(one.start_lateral_mm, one.start_anterior_mm, round(one.start_rotation_deg, 9)) for one in returns]
    assert starts == [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 3), (-1, 0, 0), (0, -1, 0), (0, 0, -3)]
    for one in returns:
        assert one.settled
        # the scan lies 0.45 mm beside the place of rest and 0.5 mm before it
        assert one.shift_mm == pytest.approx(np.hypot(0.4, 0.2), abs=PLACE_MM)
        assert one.sinking_mm == pytest.approx(REST_MM - 5.5, abs=FACETS_MM)


def test_progress_counts_cells_up_to_all_of_them(swept: tuple[Run, Findings]) -> None:
    told = swept[0].told
    assert [total for _, total in told] == [4] * len(told)
    done = [count for count, _ in told]
    assert done == sorted(done)
    assert done[-1] == 4


def test_a_full_table_is_only_noted(swept: tuple[Run, Findings]) -> None:
    assert [(one.code, one.message) for one in swept[1]] == [("N-SWP-01", "4 attitudes: 4 ok.")]


def test_two_jobs_give_the_same_bytes(swept: tuple[Run, Findings]) -> None:
    run = Run(STAGE, inputs(ball()), jobs=2)
    assert run.go(Params(**SMALL)) == swept[1]
    assert RAW_TABLE.encode(run[RAW_TABLE]) == RAW_TABLE.encode(swept[0][RAW_TABLE])
    assert SCAN_RETURNS.encode(run[SCAN_RETURNS]) == SCAN_RETURNS.encode(swept[0][SCAN_RETURNS])


def test_a_joint_without_any_stable_pose_is_refused() -> None:
    """A ball that starts 200 mm beside the joint meets nothing."""
    beside = shifted(ball(), x=200.0)
    run = Run(STAGE, inputs(beside))
    with pytest.raises(CaseRejected, match="E-SWP-01 No stable pose at any of 4 attitudes: 2 no contact, 2 not conver"):
        run.go(Params(**SMALL))
    assert run.left == {}


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
    assert findings[1].message == "2 of 4 attitudes have no stable pose (2 ok, 2 slid off)."


# --- settings


def test_the_grid_includes_both_ends() -> None:
    grid = Params(flexion_min_deg=-5.0, flexion_max_deg=20.0, flexion_step_deg=2.5, varus_step_deg=4.0).grid()
    np.testing.assert_array_equal(grid.flexion_deg, np.arange(-5.0, 20.1, 2.5))
    np.testing.assert_array_equal(grid.varus_deg, [-4.0, 0.0, 4.0])


def test_one_attitude_is_a_grid() -> None:
    grid = Params(flexion_max_deg=0.0, varus_min_deg=1.0, varus_max_deg=1.0).grid()
    assert grid.shape == (1, 1)
    assert (grid.flexion_deg[0], grid.varus_deg[0]) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"flexion_step_deg": 7.0}, r"flexion_step_deg 7\.0 does not divide the range 0\.0 to 120\.0"),
        ({"varus_step_deg": 3.0}, r"varus_step_deg 3\.0 does not divide the range -4\.0 to 4\.0"),
        ({"flexion_min_deg": 50.0, "flexion_max_deg": 40.0}, r"flexion_max_deg 40\.0 is below flexion_min_deg 50\.0"),
        ({"flexion_step_deg": 0.0625, "varus_step_deg": 0.0625}, "the grid has 247809 cells, at most 100000"),
        ({"flexion_step_deg": 0.0}, "greater than 0"),
        ({"varus_min_deg": -45.0}, "greater than or equal to -30"),
        ({"slide_bound": 3.0}, "Extra inputs are not permitted"),
    ],
)
def test_settings_that_make_no_grid_are_refused(settings: dict[str, Any], match: str) -> None:
    with pytest.raises(ValidationError, match=match):
        Params(**settings)


def test_a_hair_fine_step_is_refused_without_making_its_grid() -> None:
    with pytest.raises(ValidationError, match="the grid has 2621440625 cells, at most 100000"):
        Params(flexion_max_deg=125.0, flexion_step_deg=125.0 / 2**22, varus_step_deg=8.0 / 624.0)
