"""Which attitudes are shown, and where the moving body lies in them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.kinematics.table import Grid, Status
from pipeline.records import Side
from pipeline.report.evidence import cell, cell_motion, neutral_varus, shown_cells, shown_flexions
from tests.report.sample import sample_evidence, with_status


@pytest.mark.parametrize(
    ("flexion", "wanted", "shown"),
    [
        (np.arange(0.0, 121.0), [0.0, 30.0, 120.0], [0.0, 30.0, 120.0]),
        (np.arange(10.0, 46.0, 5.0), [0.0, 30.0, 60.0, 90.0], [10.0, 25.0, 45.0]),
        (np.arange(0.0, 101.0, 8.0), [0.0, 30.0, 60.0, 120.0], [0.0, 32.0, 56.0]),
        (np.array([0.0]), [0.0, 30.0], [0.0]),
        (np.array([0.0, 1.0]), [0.0, 0.2, 0.4], [0.0]),
    ],
)
def test_the_nearest_flexions_of_the_grid_are_shown(
    flexion: np.ndarray, wanted: list[float], shown: list[float]
) -> None:
    indices = shown_flexions(Grid(flexion, np.array([0.0])), wanted)
    assert flexion[list(indices)].tolist() == shown


def test_pictures_show_the_varus_nearest_to_zero() -> None:
    assert neutral_varus(Grid(np.array([0.0]), np.array([-4.0, -1.0, 2.0]))) == 1
    assert {shown.varus_deg for shown in shown_cells(sample_evidence().smooth, [0.0, 60.0])} == {0.0}


def test_a_shown_entry_knows_its_status() -> None:
    evidence = with_status(sample_evidence(), (3, 1), Status.ROTATION_BOUND)
    assert [shown.status.usable for shown in shown_cells(evidence.smooth, [0.0, 30.0])] == [True, False]


@pytest.mark.parametrize("side", ["right", "left"])
def test_at_the_scan_attitude_nothing_moves(side: Side) -> None:
    evidence = sample_evidence(side)
    assert cell_motion(evidence, cell(evidence.smooth, 0, 1)) == pytest.approx(np.eye(4), abs=1e-9)


@pytest.mark.parametrize("side", ["right", "left"])
def test_flexion_takes_the_far_end_of_the_moving_body_backwards(side: Side) -> None:
    evidence = sample_evidence(side)
    frame = evidence.scan_from_reference
    far = frame @ [0.0, 0.0, -100.0, 1.0]
    motion = cell_motion(evidence, cell(evidence.smooth, 9, 1))
    assert np.linalg.det(motion[:3, :3]) == pytest.approx(1.0)
    backwards = -frame[:3, 1] @ (motion @ far - far)[:3]
    assert backwards == pytest.approx(100.0, abs=5.0)
