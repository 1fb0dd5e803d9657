"""The numbers of the verdict, each broken in turn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.table import SmoothTable, Status
from pipeline.records import CrossCheck, JumpCount, Metric
from pipeline.report.contact_paths import ContactPath
from pipeline.report.evidence import Evidence
from pipeline.report.metrics import all_metrics, open_edges, untested
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


def with_sweep(**changes: Any) -> Evidence:
    """The sample with other facts of its sweep."""
    evidence = sample_evidence()
    return replace(evidence, sweep=replace(evidence.sweep, **changes))


def test_jumps_are_those_that_the_sweep_counted() -> None:
    metrics = measured(with_sweep(jumps_before=JumpCount(7, 2.5, 9.0), jumps_after=JumpCount(3, 1.5, 4.5)))
    values = {name: metrics[name].value for name in ("jumps_before", "jumps_after", "jump_mm", "jump_deg")}
    assert values == {"jumps_before": 7.0, "jumps_after": 3.0, "jump_mm": 1.5, "jump_deg": 4.5}


def test_hysteresis_is_the_largest_that_is_known() -> None:
    evidence = sample_evidence()
    known = np.full(evidence.raw.grid.shape, np.nan)
    known[3, 1], known[4, 1] = 0.4, 1.3
    raw = replace(evidence.raw, hysteresis_mm=known, hysteresis_deg=np.full_like(known, np.nan))
    metrics = measured(replace(evidence, raw=raw))
    assert metrics["hysteresis_mm"].value == 1.3
    assert "hysteresis_deg" not in metrics


def test_margins_are_medians_where_the_solver_knows_them() -> None:
    evidence = sample_evidence()
    lateral = np.full(evidence.raw.grid.shape, np.nan)
    lateral[:2] = [[5.0, 2.0, 1.0], [np.nan, 2.0, 5.0]]
    raw = replace(evidence.raw, margin_lateral_mm=lateral, margin_rotation_deg=np.full_like(lateral, np.nan))
    metrics = measured(replace(evidence, raw=raw))
    assert (metrics["margin_lateral"].value, metrics["margin_lateral"].unit) == (2.0, "mm")
    assert metrics["margin_anterior"].value == 3.0
    assert "margin_rotation" not in metrics


def test_the_cross_check_says_how_many_agree_and_how_far_apart_the_others_are() -> None:
    check = CrossCheck(40, 2, 36, 3, shift_mm=1.1, rotation_deg=2.2, deeper_mm=0.5, shallower_mm=0.06)
    metrics = measured(with_sweep(cross_check=check))
    assert metrics["cross_check_agreeing"].value == pytest.approx(90.0)
    assert "40 attitudes" in metrics["cross_check_agreeing"].meaning
    assert "in 2 more it finds none" in metrics["cross_check_agreeing"].meaning
    assert (metrics["cross_check_mm"].value, metrics["cross_check_deg"].value) == (1.1, 2.2)
    assert metrics["cross_check_shallower"].value == 0.06
    assert "3 attitudes" in metrics["cross_check_shallower"].meaning


def test_without_a_cross_check_nothing_is_said_of_it() -> None:
    metrics = measured(with_sweep(cross_check=CrossCheck(0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0)))
    assert not [name for name in metrics if name.startswith("cross_check")]


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


def test_paths_of_contact_inform_where_a_side_touches(monkeypatch: pytest.MonkeyPatch) -> None:
    places, gap = np.array([4.0, -3.0]), np.array([0.0, 0.1])
    medial = ContactPath("medial", np.array([0.0, 5.0]), np.zeros(2), places, gap)
    open_ = ContactPath("lateral", np.array([0.0, 5.0]), np.zeros(2), places, gap + 1.0)
    monkeypatch.setattr("pipeline.report.metrics.contact_paths", lambda _: (medial, open_))
    metrics = measured(sample_evidence())
    assert (metrics["contact_path_medial"].value, metrics["contact_path_medial"].state) == (7.0, "info")
    assert "contact_path_lateral" not in metrics
