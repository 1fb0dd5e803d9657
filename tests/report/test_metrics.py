"""The numbers of the verdict, each broken in turn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.table import PoseTable, SmoothTable, Status
from pipeline.records import Metric
from pipeline.report.evidence import Evidence
from pipeline.report.metrics import all_metrics, jumps, open_edges, untested
from pipeline.report.settings import Limits
from pipeline.report.verdict import guarantees
from tests.report.sample import revolved, sample_evidence, with_status

LIMITS = Limits()
CUBE_LIKE = revolved([(0.0, 1.0), (1.0, 1.0)], 4)


def measured(evidence: Evidence) -> dict[str, Metric]:
    """Metrics by name."""
    metrics = all_metrics(evidence, LIMITS)
    assert len({metric.name for metric in metrics}) == len(metrics)
    return {metric.name: metric for metric in metrics}


def without_a_triangle(evidence: Evidence) -> Evidence:
    """A hole in the femur."""
    femur = evidence.meshes["femur"]
    return replace(evidence, meshes=evidence.meshes | {"femur": TriangleMesh(femur.points, femur.triangles[1:])})


def swollen(evidence: Evidence) -> Evidence:
    """The first mesh has 3 % too much volume."""
    first, *rest = evidence.mesh_quality
    return replace(evidence, mesh_quality=(replace(first, volume_mm3=1030.0), *rest))


def with_smooth(evidence: Evidence, field: str, value: float, at: tuple[int, int] = (3, 1)) -> Evidence:
    """One number of the smoothed table replaced."""
    values = getattr(evidence.smooth, field).copy()
    values[at] = value
    changed: dict[str, Any] = {field: values}
    return replace(evidence, smooth=replace(evidence.smooth, **changed))


def not_proven(evidence: Evidence) -> Evidence:
    """One raw pose is 0.03 mm from contact."""
    gap = evidence.raw.gap_after_mm.copy()
    gap[2, 0] = 0.03
    return replace(evidence, raw=replace(evidence.raw, gap_after_mm=gap))


FAULTS: dict[str, tuple[Callable[[Evidence], Evidence], float]] = {
    "open_edges": (without_a_triangle, 3.0),
    "mesh_volume_error": (swollen, 3.0),
    "usable_cells": (lambda e: with_status(e, (5, 1), Status.SLID_OFF), 38.0),
    "raw_contact_gap": (not_proven, 0.03),
    "contact_error": (lambda e: with_smooth(e, "contact_error_mm", -0.021), 0.021),
    "midpoint_error": (lambda e: with_smooth(e, "midpoint_error_mm", 0.146), 0.146),
    "untested": (lambda e: with_smooth(e, "contact_error_mm", np.nan), 1.0),
}


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_sound_case_breaks_no_guarantee(side: str) -> None:
    metrics = measured(sample_evidence("right" if side == "right" else "left"))
    assert {metric.name for metric in metrics.values() if metric.state == "ok"} == set(guarantees())
    assert all(metric.limit == "none" for metric in metrics.values() if metric.state == "info")


@pytest.mark.parametrize("name", FAULTS)
def test_each_guarantee_fails_alone_with_its_number(name: str) -> None:
    spoil, value = FAULTS[name]
    metrics = measured(spoil(sample_evidence()))
    assert [metric.name for metric in metrics.values() if metric.state == "review"] == [name]
    assert metrics[name].value == pytest.approx(value)


def test_every_guarantee_has_a_fault_here() -> None:
    assert set(FAULTS) == set(guarantees())


def test_the_worst_structure_is_named() -> None:
    evidence = swollen(sample_evidence())
    assert evidence.mesh_quality[0].name in measured(evidence)["mesh_volume_error"].meaning
    assert "lateral epicondyle" in measured(evidence)["landmark_uncertainty"].meaning


def test_unusable_entries_are_counted_by_their_status() -> None:
    evidence = with_status(with_status(sample_evidence(), (5, 1), Status.SLID_OFF), (6, 2), Status.NO_CONTACT)
    metrics = measured(evidence)
    assert metrics["raw_status.slid_off"].value == metrics["raw_status.no_contact"].value == 1.0
    assert "raw_status.ok" not in metrics


def test_a_table_without_a_usable_entry_is_still_judged() -> None:
    evidence = sample_evidence()
    for i in range(13):
        for j in range(3):
            evidence = with_status(evidence, (i, j), Status.NO_CONTACT)
    metrics = measured(evidence)
    assert metrics["usable_cells"].value == 0.0
    assert metrics["usable_cells"].state == "review"
    assert all(np.isfinite(metric.value) for metric in metrics.values())


@pytest.mark.parametrize(
    ("triangles", "edges"),
    [
        (CUBE_LIKE.triangles, 0),
        (CUBE_LIKE.triangles[1:], 3),
        (np.vstack([CUBE_LIKE.triangles[:1, ::-1], CUBE_LIKE.triangles[1:]]), 3),
        (np.vstack([CUBE_LIKE.triangles, CUBE_LIKE.triangles[:1]]), 3),
    ],
    ids=["closed", "hole", "flipped", "doubled"],
)
def test_open_edges(triangles: np.ndarray, edges: int) -> None:
    assert open_edges(TriangleMesh(CUBE_LIKE.points, triangles.astype(np.int32))) == edges


def poses(**changes: np.ndarray) -> PoseTable:
    """The sample's smoothed poses with some arrays replaced."""
    return replace(sample_evidence().smooth.poses, **changes)


def test_one_displaced_pose_makes_four_steps() -> None:
    fitted = sample_evidence().smooth.poses
    lateral = fitted.lateral_mm.copy()
    lateral[4, 1] += 2.0
    shift, turn = jumps(poses(lateral_mm=lateral), fitted)
    assert np.sort(shift)[-4:] == pytest.approx(2.0)
    assert np.sort(shift)[:-4] == pytest.approx(0.0)
    assert turn == pytest.approx(0.0)


def test_the_motion_itself_is_no_jump() -> None:
    shift, turn = jumps(sample_evidence().smooth.poses, sample_evidence().smooth.poses)
    assert not shift.any()
    assert not turn.any()


def test_the_scan_pose_counts_the_worst_release_and_the_lost_ones() -> None:
    evidence = sample_evidence()
    lost = replace(evidence.scan_returns[0], settled=False)
    metrics = measured(replace(evidence, scan_returns=(*evidence.scan_returns, lost)))
    assert metrics["scan_pose_mm"].value == max(one.shift_mm for one in evidence.scan_returns)
    assert metrics["scan_pose_deg"].value == max(one.rotation_deg for one in evidence.scan_returns)
    assert metrics["scan_pose_lost"].value == 1.0
    assert "scan_pose_mm" not in measured(replace(evidence, scan_returns=(lost,)))


def test_middles_beside_an_unusable_entry_need_no_test() -> None:
    evidence = with_status(sample_evidence(), (5, 1), Status.SLID_OFF)
    for field, rows in (("contact_error_mm", [5]), ("midpoint_error_mm", [4, 5])):
        for row in rows:
            evidence = with_smooth(evidence, field, np.nan, (row, 1))
    smooth: SmoothTable = evidence.smooth
    assert untested(smooth) == 0
    assert untested(with_smooth(evidence, "midpoint_error_mm", np.nan, (0, 0)).smooth) == 1
