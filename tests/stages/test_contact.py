"""Stage 50: the two contact bodies, from labels and from meshes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.artifacts import (
    ANATOMY,
    CASE_FACTS,
    LABELS,
    MADE_MESHES,
    MESHES,
    MOVING_BODY,
    REFERENCE_BODY,
    SURFACE_ORIGINS,
)
from pipeline.engine.stage import Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.geometry.mesh import TriangleMesh, check_closed, components, genus, merged, volume_mm3
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels, phantom_truth
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.volume import LabelVolume
from pipeline.records import Anatomy, SurfaceOrigin
from pipeline.stages.contact import STAGE, Params
from tests.geometry.knees import sphere
from tests.stages.in_memory import Run, anatomy, facts

STRUCTURES = {"femur": 1, "tibia": 2, "femoral_cartilage": 3}
PARAMS = Params(reference=["femur", "femoral_cartilage"], moving=["tibia", "medial_meniscus"], triangles=2000)
LPS_FROM_INDEX = np.array([[-1.0, 0, 0, 20], [0, -1.0, 0, 15], [0, 0, 1.0, -60], [0, 0, 0, 1.0]])


def joint_labels() -> NDArray[np.uint8]:
    """A femur of 30 x 24 mm with a layer of cartilage below it, a gap of two voxels, a tibia with a 60 mm shaft."""
    values = np.zeros((40, 30, 120), dtype=np.uint8)
    values[5:35, 3:27, 84:116] = 1
    values[5:35, 3:27, 81:84] = 3
    values[5:35, 3:27, 60:79] = 2
    values[14:26, 10:20, 1:60] = 2
    return values


def placed(lps_from_index: Any = LPS_FROM_INDEX) -> Anatomy:
    """Frames whose origin is the middle of the plateau."""
    frame = np.eye(4)
    frame[:3, 3] = lps_from_index[:3, :3] @ [20.0, 15.0, 79.0] + lps_from_index[:3, 3]
    return anatomy(frame, frame, (0.0,) * 6)


def contact(values: NDArray[np.uint8], params: Params = PARAMS, jobs: int = 1, **changes: Any) -> tuple[Run, Findings]:
    run = Run(
        STAGE,
        {
            CASE_FACTS.name: facts(**{"structures": STRUCTURES, **changes}),
            LABELS.name: LabelVolume(values, LPS_FROM_INDEX),
            ANATOMY.name: placed(),
            MESHES.name: {},
        },
        jobs,
    )
    return run, run.go(params)


@pytest.fixture(scope="module")
def made() -> tuple[Run, Findings]:
    return contact(joint_labels())


def test_both_bodies_are_closed_outward_and_as_large_as_their_labels(made: tuple[Run, Findings]) -> None:
    run, _ = made
    for artifact, labels in ((REFERENCE_BODY, (1, 3)), (MOVING_BODY, (2,))):
        mesh = run[artifact]
        check_closed(mesh, artifact.name)
        assert len(mesh.triangles) <= 2000
        assert volume_mm3(mesh) == pytest.approx(np.isin(joint_labels(), labels).sum(), rel=0.04)


def test_two_jobs_give_the_same_bytes(made: tuple[Run, Findings]) -> None:
    run, findings = contact(joint_labels(), jobs=2)
    assert findings == made[1]
    for artifact in (REFERENCE_BODY, MOVING_BODY):
        for name in ("points", "triangles"):
            assert getattr(run[artifact], name).tobytes() == getattr(made[0][artifact], name).tobytes()


def test_cartilage_and_bone_are_one_surface_in_scan_space(made: tuple[Run, Findings]) -> None:
    assert len(components(made[0][REFERENCE_BODY])) == 1
    # cartilage begins at index 81: half a voxel below its first layer, in LPS; likewise the top of the tibia at 78
    for artifact, face_mm in ((REFERENCE_BODY, 80.5 - 60.0), (MOVING_BODY, 78.5 - 60.0)):
        points = made[0][artifact].points
        near = np.all(np.abs(points - [0.0, 0.0, face_mm]) < [7.0, 6.0, 2.0], axis=1)
        np.testing.assert_allclose(points[near, 2], face_mm, rtol=0, atol=0.3)


def test_origins_and_findings_say_what_is_labelled_and_what_is_missing(made: tuple[Run, Findings]) -> None:
    run, findings = made
    assert run[SURFACE_ORIGINS] == (
        SurfaceOrigin("reference", "femur", "labelled"),
        SurfaceOrigin("reference", "femoral_cartilage", "labelled"),
        SurfaceOrigin("moving", "tibia", "labelled"),
        SurfaceOrigin("moving", "medial_meniscus", "absent"),
    )
    assert [(one.code, one.severity) for one in findings] == [
        ("N-CON-01", Severity.NOTE),
        ("N-CON-01", Severity.NOTE),
        ("W-CON-01", Severity.REVIEW),
    ]
    assert findings[2].message == "Not labelled and therefore not part of the contact: medial meniscus."
    assert findings[0].message.startswith("Reference body: ")


def test_nothing_missing_is_not_reported() -> None:
    params = PARAMS.model_copy(update={"moving": ["tibia"]})
    assert {one.code for one in contact(joint_labels(), params)[1]} == {"N-CON-01"}


def test_the_reach_crops_a_long_shaft() -> None:
    run, _ = contact(joint_labels(), PARAMS.model_copy(update={"reach_mm": 40.0}))
    mesh = run[MOVING_BODY]
    check_closed(mesh, "moving")
    origin = np.array(placed().scan_from_moving)[:3, 3]
    farthest = np.linalg.norm(mesh.points - origin, axis=1).max()
    assert 38.0 < farthest < 41.0
    assert np.linalg.norm(run[REFERENCE_BODY].points - origin, axis=1).max() < 41.0


@pytest.mark.parametrize(("filled", "handles"), [(False, 0), (True, 1)])
def test_a_gap_is_closed_unless_the_other_body_lies_in_it(filled: bool, handles: int) -> None:  # noqa: FBT001 - a case
    """A tunnel of one voxel through the femur; with the tibia's voxels in it, it must stay open."""
    values = joint_labels()
    values[20, :, 100] = 2 if filled else 0
    # joined to the tibia, so that it is no loose piece of it
    values[20, 27:29, 70:101] = 2 if filled else 0
    values[20, 29, 60:101] = 2 if filled else 0
    run, _ = contact(values, PARAMS.model_copy(update={"triangles": 20_000}))
    assert genus(run[REFERENCE_BODY]) == handles


def test_a_left_joint_gives_the_mirrored_bodies() -> None:
    """The canonical array of a left joint is that of the right one reversed along patient left."""
    right, _ = contact(joint_labels())
    reversed_matrix = LPS_FROM_INDEX.copy()
    reversed_matrix[0] *= -1.0  # the mirrored patient ...
    reversed_matrix[:3, 3] += reversed_matrix[:3, 0] * 39
    reversed_matrix[:3, 0] *= -1.0  # ... stored in the same direction
    mirrored = placed(LPS_FROM_INDEX * np.array([[-1.0], [1.0], [1.0], [1.0]]))
    run = Run(
        STAGE,
        {
            CASE_FACTS.name: facts(structures=STRUCTURES, side="left"),
            LABELS.name: LabelVolume(np.ascontiguousarray(joint_labels()[::-1]), reversed_matrix),
            ANATOMY.name: mirrored,
            MESHES.name: {},
        },
    )
    run.go(PARAMS)
    np.testing.assert_allclose(run[MOVING_BODY].points * [-1, 1, 1], right[MOVING_BODY].points, rtol=0, atol=1e-12)
    check_closed(run[MOVING_BODY], "left")


def test_a_body_without_voxels_is_refused() -> None:
    params = PARAMS.model_copy(update={"reference": ["patella"]})
    with pytest.raises(CaseRejected, match="E-CON-01 The reference contact body has no closed surface: expected a 3-D"):
        contact(joint_labels(), params)


# --- a case of meshes


def of_meshes(meshes: dict[str, TriangleMesh], params: Params = PARAMS) -> tuple[Run, Findings]:
    structures = dict.fromkeys(meshes, 0)
    given = {CASE_FACTS.name: facts(source="meshes", structures=structures), MESHES.name: meshes}
    run = Run(STAGE, {**given, LABELS.name: None, ANATOMY.name: placed()})
    return run, run.go(params)


def test_meshes_are_merged_as_they_are() -> None:
    femur, cartilage, tibia = (sphere(10.0, (0.0, 0.0, z), fine=2) for z in (30.0, 15.0, -20.0))
    run, findings = of_meshes({"femur": femur, "femoral_cartilage": cartilage, "tibia": tibia})
    expected = merged([femur, cartilage])
    np.testing.assert_array_equal(run[REFERENCE_BODY].points, expected.points)
    np.testing.assert_array_equal(run[REFERENCE_BODY].triangles, expected.triangles)
    np.testing.assert_array_equal(run[MOVING_BODY].points, tibia.points)
    assert [one.code for one in findings] == ["W-CON-01"]


def test_a_body_without_meshes_is_refused() -> None:
    with pytest.raises(CaseRejected, match="E-CON-01 The moving contact body has no closed surface: expected at least"):
        of_meshes({"femur": sphere(10.0, fine=1)})


@pytest.fixture(scope="module")
def bare_knee() -> dict[str, Any]:
    """The bones of a coarse phantom, without cartilage and menisci, with its true frames."""
    spec = PhantomSpec(spacing_mm=(1.0, 1.0, 1.0))
    labels, truth = phantom_labels(spec), phantom_truth(spec)
    values = np.zeros_like(labels.values)
    values[labels.values == PHANTOM_LABELS["femur"]] = 1
    values[labels.values == PHANTOM_LABELS["tibia"]] = 2
    attitude = tuple(float(value) for value in truth.scan_attitude)
    return {
        CASE_FACTS.name: facts(structures={"femur": 1, "tibia": 2}),
        LABELS.name: LabelVolume(values, labels.lps_from_index),
        ANATOMY.name: anatomy(truth.scan_from_reference, truth.scan_from_moving, attitude),  # type: ignore[arg-type]
        MESHES.name: {},
    }


KNEE = Params(
    reference=["femur", "femoral_cartilage"],
    moving=["tibia", "medial_tibial_cartilage", "lateral_tibial_cartilage", "medial_meniscus", "lateral_meniscus"],
    triangles=20_000,
)


def meshes_of(run: Run) -> dict[str, TriangleMesh]:
    return run[MADE_MESHES]


def test_missing_cartilage_and_menisci_are_made_where_that_is_wanted(bare_knee: dict[str, Any]) -> None:
    run = Run(STAGE, dict(bare_knee))
    findings = run.go(KNEE.model_copy(update={"missing_surfaces": "make"}))
    made = {one.structure for one in run[SURFACE_ORIGINS] if one.origin == "synthesised"}
    assert made == set(KNEE.reference[1:] + KNEE.moving[1:])
    assert made == set(meshes_of(run))
    assert [one.code for one in findings] == ["N-CON-01", "N-CON-01", "N-CON-02"]
    assert findings[-1].message.startswith("Made from the bones, not seen in the scan: femoral cartilage, ")
    for name, mesh in run[MADE_MESHES].items():
        check_closed(mesh, name)
    # the bodies are the bones and what was made on them
    assert volume_mm3(run[REFERENCE_BODY]) > volume_mm3(run[MADE_MESHES]["femoral_cartilage"]) > 3000.0
    gap = (
        run[MADE_MESHES]["medial_meniscus"].points[:, 2].max() - run[MADE_MESHES]["medial_meniscus"].points[:, 2].min()
    )
    assert 3.0 < gap < 12.0


def test_bones_alone_stay_alone_where_that_is_wanted(bare_knee: dict[str, Any]) -> None:
    run = Run(STAGE, dict(bare_knee))
    findings = run.go(KNEE)
    assert run[MADE_MESHES] == {}
    assert {one.origin for one in run[SURFACE_ORIGINS]} == {"labelled", "absent"}
    assert [one.code for one in findings] == ["N-CON-01", "N-CON-01", "W-CON-01"]


def test_a_filler_stands_for_all_that_is_missing(bare_knee: dict[str, Any]) -> None:
    run = Run(STAGE, dict(bare_knee))
    findings = run.go(KNEE.model_copy(update={"missing_surfaces": "filler"}))
    assert set(meshes_of(run)) == {"joint_space_filler"}
    assert SurfaceOrigin("moving", "joint_space_filler", "synthesised") in run[SURFACE_ORIGINS]
    assert [one.code for one in findings] == ["N-CON-01", "N-CON-01", "N-CON-02"]


def test_a_left_knee_gets_the_mirror_image_of_a_right_one(bare_knee: dict[str, Any]) -> None:
    right, left = Run(STAGE, dict(bare_knee)), Run(STAGE, dict(bare_knee))
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    labels, seen = bare_knee[LABELS.name], bare_knee[ANATOMY.name]
    turned = LabelVolume(labels.values[::-1], mirror @ _reversed(labels))
    frames = (mirror @ np.array(seen.scan_from_reference), mirror @ np.array(seen.scan_from_moving))
    left.given |= {
        LABELS.name: turned,
        CASE_FACTS.name: facts(structures={"femur": 1, "tibia": 2}, side="left"),
        ANATOMY.name: replace(anatomy(*frames, seen.scan_attitude), side="left"),
    }
    params = KNEE.model_copy(update={"missing_surfaces": "make"})
    right.go(params)
    left.go(params)
    for artifact in (REFERENCE_BODY, MOVING_BODY):
        np.testing.assert_allclose(left[artifact].points * [-1.0, 1.0, 1.0], right[artifact].points, atol=1e-6)


def _reversed(labels: LabelVolume) -> NDArray[np.float64]:
    """The matrix of the same volume stored with its first axis the other way round."""
    matrix = labels.lps_from_index.copy()
    matrix[:3, 3] += matrix[:3, 0] * (labels.values.shape[0] - 1)
    matrix[:3, 0] *= -1.0
    return matrix


@pytest.mark.parametrize(
    ("rotation_deg", "lateral_mm", "told"),
    [
        (30.0, 0.0, "the tibia lies turned 30 deg inwardly (at rest at most 12 deg)"),
        (-20.0, 0.0, "the tibia lies turned 20 deg outwardly"),
        (0.0, 5.5, "the tibia lies 5.5 mm too far to lateral (at rest within 3 mm)"),
        (15.0, -4.0, "turned 15 deg inwardly (at rest at most 12 deg) and 4.0 mm too far to medial"),
    ],
)
def test_a_scan_of_no_knee_at_rest_is_told(
    bare_knee: dict[str, Any], rotation_deg: float, lateral_mm: float, told: str
) -> None:
    seen = bare_knee[ANATOMY.name]
    flexion, varus, _, _, *shift = seen.scan_attitude
    attitude = (flexion, varus, rotation_deg, lateral_mm, *shift)
    run = Run(STAGE, {**bare_knee, ANATOMY.name: replace(seen, scan_attitude=attitude)})
    findings = run.go(KNEE.model_copy(update={"missing_surfaces": "make"}))
    (finding,) = [one for one in findings if one.code == "W-CON-03"]
    assert finding.severity is Severity.REVIEW
    assert told in finding.message


def test_surfaces_of_a_knee_beside_its_place_are_those_of_one_in_it(bare_knee: dict[str, Any]) -> None:
    seen, made = bare_knee[ANATOMY.name], []
    flexion, varus, rotation, _, *shift = seen.scan_attitude
    for lateral in (0.0, -6.0):
        attitude = (flexion, varus, rotation, lateral, *shift)
        run = Run(STAGE, {**bare_knee, ANATOMY.name: replace(seen, scan_attitude=attitude)})
        run.go(KNEE.model_copy(update={"missing_surfaces": "make"}))
        made.append(run[MOVING_BODY].points)
    np.testing.assert_array_equal(made[0], made[1])


def test_bones_that_are_no_knee_are_refused(bare_knee: dict[str, Any]) -> None:
    seen = bare_knee[ANATOMY.name]
    away = np.array(seen.scan_from_moving)
    away[:3, 3] += 60.0 * away[:3, 2]
    wrong = anatomy(np.array(seen.scan_from_reference), away, seen.scan_attitude)
    run = Run(STAGE, {**bare_knee, ANATOMY.name: wrong})
    with pytest.raises(CaseRejected, match="E-CON-02 Cartilage and menisci cannot be made from these bones"):
        run.go(KNEE.model_copy(update={"missing_surfaces": "make"}))
