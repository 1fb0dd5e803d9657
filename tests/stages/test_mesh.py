"""Stage 30 on small label volumes and, where it is present, on a real knee."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.artifacts import CASE_FACTS, GIVEN_MESHES, LABELS, MESH_QUALITY, MESHES
from pipeline.engine.stage import Findings
from pipeline.errors import CaseRejected
from pipeline.files.volumes import read_label_map
from pipeline.geometry.mesh import TriangleMesh, check_closed, flipped, merged, volume_mm3
from pipeline.geometry.volume import LabelVolume
from pipeline.records import CaseFacts, Side
from pipeline.stages.mesh import STAGE, Params
from tests.geometry.meshes import ball, octahedron

SMALL = Params(required=["femur", "tibia"], triangles=1500, triangles_of={})
DATA = Path(__file__).resolve().parents[2].parent / "shared/data/knee_mr_a/labels.nrrd"


class _Out(dict[Any, Any]):
    def __init__(self, jobs: int) -> None:
        super().__init__()
        self.jobs = jobs
        self.steps: list[tuple[int, int]] = []

    def progress(self, done: int, total: int) -> None:
        self.steps.append((done, total))

    def took(self, part: str, seconds: float) -> None:
        """Nobody asks how long it took."""


def _facts(structures: dict[str, int], side: Side = "right") -> CaseFacts:
    return CaseFacts(
        case_id="A", joint="knee", side=side, source="labels", source_files={}, structures=structures,
        voxels={}, spacing_mm=(1.0, 1.0, 1.0), shape=(1, 1, 1), clipped_mm2={}, landmarks={},
    )  # fmt: skip


def _two_balls(gap: int = 3) -> NDArray[np.uint8]:
    one = ball(8.0, (1.0, 1.0, 1.0)).astype(np.uint8)
    return np.concatenate([one, np.zeros((gap, *one.shape[1:]), dtype=np.uint8), 2 * one])


def _run(
    values: NDArray[np.uint8] | None,
    given: dict[str, TriangleMesh] | None = None,
    *,
    params: Params = SMALL,
    side: Side = "right",
    matrix: NDArray[np.float64] | None = None,
    jobs: int = 1,
) -> tuple[_Out, Findings]:
    structures = {"femur": 2, "tibia": 1, **({} if values is None or values.max() < 3 else {"men": 3})}
    volume = None if values is None else LabelVolume(values, np.eye(4) if matrix is None else matrix)
    out = _Out(jobs)
    reads: Any = {CASE_FACTS: _facts(structures, side), LABELS: volume, GIVEN_MESHES: given or {}}
    findings = STAGE.run(reads, params, out)
    return out, findings


def test_every_structure_becomes_a_closed_mesh_with_its_quality() -> None:
    out, findings = _run(_two_balls())
    assert list(out[MESHES]) == ["femur", "tibia"]
    for name, mesh in out[MESHES].items():
        check_closed(mesh, name)
    for quality in out[MESH_QUALITY]:
        assert quality.volume_mm3 == pytest.approx(volume_mm3(out[MESHES][quality.name]))
        assert quality.volume_mm3 == pytest.approx(quality.label_volume_mm3, rel=0.02)
        assert 0.0 < quality.deviation_rms_mm < quality.deviation_max_mm < 1.0
    assert findings == ()
    assert out.steps == [(0, 2), (1, 2), (2, 2)]


def test_two_jobs_give_the_same_bytes() -> None:
    (one, findings), (two, same) = (_run(_two_balls(), jobs=jobs) for jobs in (1, 2))
    assert findings == same
    assert two[MESH_QUALITY] == one[MESH_QUALITY]
    assert two.steps == one.steps
    for name, mesh in one[MESHES].items():
        assert two[MESHES][name].points.tobytes() == mesh.points.tobytes()
        assert two[MESHES][name].triangles.tobytes() == mesh.triangles.tobytes()


def test_a_left_joint_gives_the_exact_mirror_image_of_the_right_one() -> None:
    values = _two_balls()
    values[12:14, 12:, 5:9] = 1
    matrix = np.diag([0.5, 0.5, 0.6, 1.0])
    right, _ = _run(values, matrix=matrix)
    mirrored = matrix.copy()
    mirrored[0, 3] = -0.5 * (len(values) - 1)
    left, _ = _run(np.ascontiguousarray(values[::-1]), side="left", matrix=mirrored)
    for name in ("femur", "tibia"):
        assert np.allclose(left[MESHES][name].points, right[MESHES][name].points * [-1.0, 1.0, 1.0], atol=1e-12)
        check_closed(left[MESHES][name], name)


def test_a_required_bone_in_two_pieces_is_refused() -> None:
    values = _two_balls()
    values[values == 2] = 1
    values[:3, :3, :3] = 2
    with pytest.raises(CaseRejected, match=r"E-MSH-01 The label of tibia .* 2 separate pieces"):
        _run(values)


def test_a_structure_that_is_not_required_may_be_in_pieces() -> None:
    values = np.concatenate([_two_balls(), np.zeros((20, 22, 22), dtype=np.uint8)])
    values[-15:-11, 4:18, 4:18] = values[-8:-4, 4:18, 4:18] = 3
    out, findings = _run(values)
    assert list(out[MESHES]) == ["femur", "men", "tibia"]
    assert [finding.code for finding in findings if "pieces" in finding.message] == ["N-MSH-04"]


def test_a_structure_that_cannot_be_meshed_is_left_out_or_refused() -> None:
    values = _two_balls()
    values[values == 2] = 0
    with pytest.raises(CaseRejected, match=r"E-MSH-01 .* femur .* Correct the segmentation"):
        _run(values)
    out, findings = _run(values, params=SMALL.model_copy(update={"required": ["tibia"]}))
    assert list(out[MESHES]) == ["tibia"]
    assert [(finding.code, finding.severity.value) for finding in findings] == [("W-MSH-04", "review")]


def test_lost_volume_deviation_and_wear_ask_for_a_review() -> None:
    values = np.concatenate([_two_balls(), np.zeros((8, 22, 22), dtype=np.uint8)])
    values[-5:-4, 2:20, 2:20] = 3
    params = SMALL.model_copy(update={"deviation_limit_factor": 0.05, "smoothing_pass_bands": [0.001]})
    _, findings = _run(values, params=params)
    codes = {finding.code for finding in findings if " men " in finding.message or finding.message.endswith("men.")}
    assert {"W-MSH-01", "W-MSH-02"} <= codes
    assert any(finding.code == "W-MSH-03" for finding in findings)
    assert all("\n" not in finding.message for finding in findings)


def test_what_was_mended_is_noted() -> None:
    values = _two_balls()
    values[0, 0, 0] = 1
    _, findings = _run(values)
    assert [finding.code for finding in findings] == ["N-MSH-02"]


def test_given_meshes_pass_through_untouched() -> None:
    given = {"tibia": octahedron(20.0), "femur": merged([octahedron(3.0), octahedron(9.0)])}
    out, findings = _run(None, given)
    assert out[MESHES]["tibia"] is given["tibia"]
    assert [quality.volume_mm3 for quality in out[MESH_QUALITY]] == [
        quality.label_volume_mm3 for quality in out[MESH_QUALITY]
    ]
    assert findings == ()


def test_a_given_mesh_inside_out_is_turned() -> None:
    out, findings = _run(None, {"tibia": flipped(octahedron(20.0))})
    check_closed(out[MESHES]["tibia"], "tibia")
    assert [finding.code for finding in findings] == ["N-MSH-03"]


def test_an_open_given_mesh_is_refused() -> None:
    mesh = octahedron(20.0)
    with pytest.raises(CaseRejected, match=r"E-MSH-02 The given mesh tibia has 3 open edges"):
        _run(None, {"tibia": TriangleMesh(mesh.points, mesh.triangles[1:])})


def test_importing_the_stage_does_not_import_vtk() -> None:
    code = "import sys, pipeline.stages.mesh; sys.exit(any(m.startswith(('vtk', 'scipy')) for m in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], check=False).returncode == 0


@pytest.mark.skipif(not DATA.is_file(), reason="real knee knee_mr_a is not beside the checkout")
def test_thin_sheets_of_a_real_knee() -> None:
    volume = read_label_map(DATA.read_bytes(), "labels.nrrd").volume
    kept = {4: 1, 10: 2}  # patellar cartilage and medial meniscus, by the names of the two structures of these tests
    values = np.select([volume.values == old for old in kept], list(kept.values()), 0).astype(np.uint8)
    params = Params(triangles=5000, triangles_of={}, required=[])
    out, findings = _run(values, params=params, matrix=volume.lps_from_index)
    assert len(out[MESHES]) == 2
    for name, mesh in out[MESHES].items():
        check_closed(mesh, name)
        assert len(mesh.triangles) <= 5000
    for quality in out[MESH_QUALITY]:
        assert quality.volume_mm3 == pytest.approx(quality.label_volume_mm3, rel=0.02)
        assert quality.deviation_rms_mm < 0.15
    assert {finding.severity for finding in findings} <= {"note"}
