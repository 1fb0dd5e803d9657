"""Stage 40: frames found or given, landmarks checked, a contradicted side refused."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from pipeline.artifacts import ANATOMY, CASE_FACTS, MESHES
from pipeline.engine.stage import Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.geometry.directions import angle_deg
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.joint_coordinates import rigid
from pipeline.records import Anatomy
from pipeline.stages.anatomy import STAGE, Params
from tests.geometry.knees import MIRROR, about, moved, phantom_knee, sphere
from tests.stages.in_memory import Run, facts, scanned

FEMUR = rigid(about(10.0, -20.0, 170.0), np.array([30.0, -80.0, 400.0]))
ATTITUDE = (25.0, -3.0, 6.0, 1.5, -2.5, -20.0)
TIBIA = scanned(FEMUR, ATTITUDE)


def run_on(meshes: Any, params: Params, **changes: Any) -> tuple[Anatomy, Findings]:
    run = Run(STAGE, {CASE_FACTS.name: facts(**changes), MESHES.name: meshes})
    findings = run.go(params)
    return run[ANATOMY], findings


def found(meshes: Any = None, **changes: Any) -> tuple[Anatomy, Findings]:
    """The phantom by default."""
    return run_on(phantom_knee()[0] if meshes is None else meshes, Params(), **changes)


def given(reference: Any, moving: Any, **changes: Any) -> Anatomy:
    params = Params(method="given", scan_from_reference=reference.tolist(), scan_from_moving=moving.tolist())
    return run_on({}, params, **changes)[0]


# --- found


def test_a_knee_is_recorded_with_its_frames_attitude_and_evidence() -> None:
    anatomy, findings = found()
    truth = phantom_knee()[1]
    assert findings == ()
    assert anatomy.side == "right"
    assert {one.name for one in anatomy.axes} == {
        "flexion_axis", "femoral_long_axis", "tibial_long_axis", "tibial_mediolateral_axis"
    }  # fmt: skip
    assert [one.name for one in anatomy.landmarks] == sorted(one.name for one in anatomy.landmarks)
    assert {one.source for one in anatomy.landmarks} == {"found"}
    assert angle_deg(np.array(anatomy.scan_from_reference)[:3, 0], truth.flexion_axis) < 0.7
    assert anatomy.delta == pytest.approx(tuple(np.array(anatomy.scan_from_moving)[:3, 2]), abs=1e-12)
    assert anatomy.scan_attitude[0] == pytest.approx(truth.scan_attitude[0], abs=0.5)
    assert anatomy.scan_attitude[1] == pytest.approx(0.0, abs=1e-9)
    assert anatomy.side_evidence[0].startswith("the fibula lies")


def test_a_left_knee_has_left_handed_frames_and_the_same_attitude() -> None:
    right, _ = found()
    left, _ = found(moved(phantom_knee()[0], MIRROR), side="left")
    assert np.linalg.det(np.array(left.scan_from_reference)) == pytest.approx(-1.0)
    assert left.scan_attitude == pytest.approx(right.scan_attitude, abs=1e-9)


def test_the_push_may_be_given_and_is_made_a_unit_vector() -> None:
    anatomy, _ = run_on(phantom_knee()[0], Params(delta=[0.0, -0.6, 2.0]))
    assert anatomy.delta == pytest.approx(tuple(np.array([0.0, -0.6, 2.0]) / np.hypot(0.6, 2.0)))


def test_given_landmarks_are_recorded_as_given() -> None:
    centre = tuple(float(value) for value in phantom_knee()[1].landmarks["medial_condyle_centre"])
    anatomy, _ = found(landmarks={"medial_condyle_centre": centre})
    (landmark,) = [one for one in anatomy.landmarks if one.source == "given"]
    assert (landmark.name, landmark.position) == ("medial_condyle_centre", centre)


def test_bones_alone_ask_for_a_look_at_the_side() -> None:
    _, findings = found({name: phantom_knee()[0][name] for name in ("femur", "tibia", "patella")})
    assert [(one.code, one.severity) for one in findings] == [("W-SIDE-01", Severity.REVIEW)]


def test_an_uncertain_axis_asks_for_review() -> None:
    _, findings = run_on(phantom_knee()[0], Params(max_long_axis_uncertainty_deg=1.0))
    assert [one.code for one in findings] == ["W-ANA-01", "W-ANA-01"]
    assert re.match(
        r"The femoral long axis is uncertain by \d\.\d deg \(limit 1\.0\): give landmarks", findings[0].message
    )


# --- refused


def test_the_wrong_side_is_refused() -> None:
    with pytest.raises(CaseRejected, match=r"E-SIDE-02 The case says left knee, but the fibula lies \d+ mm medial of"):
        found(side="left")


def test_an_unknown_landmark_is_refused_with_the_known_names() -> None:
    with pytest.raises(CaseRejected, match=r"E-LMK-01 Unknown landmark knee_centre\. Use these names: femoral_head_"):
        found(landmarks={"knee_centre": (0.0, 0.0, 0.0)})


def test_a_landmark_far_from_its_bone_is_refused() -> None:
    x, y, z = (float(value) for value in phantom_knee()[1].landmarks["medial_condyle_centre"])
    with pytest.raises(CaseRejected, match=r"E-LMK-02 Landmark medial_condyle_centre lies \d+ mm from the femur\."):
        found(landmarks={"medial_condyle_centre": (x, y, z + 300.0)})


def test_landmarks_of_the_other_coordinate_system_are_recognised() -> None:
    """The phantom stands near the origin, so it is moved to where LPS and RAS differ."""
    far = moved(phantom_knee()[0], rigid(np.eye(3), np.array([100.0, 150.0, 0.0])))
    x, y, z = phantom_knee()[1].landmarks["lateral_plateau_centre"] + np.array([100.0, 150.0, 0.0])
    with pytest.raises(CaseRejected, match=r"from the tibia; read the other way \(RAS as LPS\) it would fit"):
        found(far, landmarks={"lateral_plateau_centre": (-float(x), -float(y), float(z))})


def test_a_scan_that_shows_too_little_is_refused() -> None:
    stump: dict[str, TriangleMesh] = {**phantom_knee()[0], "tibia": sphere(8.0, (30.0, -20.0, 60.0), fine=2)}
    with pytest.raises(CaseRejected, match=r"E-ANA-01 The long axis of the tibia was not found \(fewer than 6"):
        found(stump)


# --- given frames


def test_given_frames_are_taken_with_the_attitude_between_them() -> None:
    anatomy = given(FEMUR, TIBIA)
    np.testing.assert_array_equal(anatomy.scan_from_reference, FEMUR)
    np.testing.assert_array_equal(anatomy.scan_from_moving, TIBIA)
    assert anatomy.scan_attitude == pytest.approx(ATTITUDE, abs=1e-9)
    assert anatomy.delta == pytest.approx(tuple(TIBIA[:3, 2]))


def test_a_left_joint_takes_left_handed_frames_with_the_same_attitude() -> None:
    assert given(MIRROR @ FEMUR, MIRROR @ TIBIA, side="left").scan_attitude == pytest.approx(ATTITUDE, abs=1e-9)


def test_a_frame_of_the_other_side_is_refused() -> None:
    with pytest.raises(CaseRejected, match="E-ANA-03 scan_from_moving is not a 4x4 right-handed orthonormal frame"):
        given(FEMUR, MIRROR @ TIBIA)
    with pytest.raises(CaseRejected, match="E-ANA-03 scan_from_reference is not a 4x4 left-handed orthonormal frame"):
        given(FEMUR, MIRROR @ TIBIA, side="left")


@pytest.mark.parametrize(
    "frame", [FEMUR * 1.01, FEMUR[:3], np.vstack([FEMUR[:3], [0, 0, 0, 2]])], ids=["scaled", "3x4", "last row"]
)
def test_what_is_no_frame_is_refused(frame: Any) -> None:
    with pytest.raises(CaseRejected, match="E-ANA-03 scan_from_reference is not"):
        given(frame, TIBIA)


def test_rows_of_unequal_length_are_refused_with_the_settings() -> None:
    ragged = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0]]
    with pytest.raises(ValidationError, match="at least 4 items"):
        Params(method="given", scan_from_reference=ragged, scan_from_moving=TIBIA.tolist())


def test_a_missing_frame_is_refused() -> None:
    with pytest.raises(CaseRejected, match="E-ANA-02"):
        run_on({}, Params(method="given", scan_from_reference=FEMUR.tolist()))
