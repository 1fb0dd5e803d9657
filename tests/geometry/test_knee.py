"""The anatomy of a whole knee: against the phantom's truth, mirrored, moved, with given landmarks, and a real one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from pipeline.adapters.mask_surface import SurfaceSettings, mask_to_mesh
from pipeline.files.volumes import read_label_map
from pipeline.geometry.directions import angle_deg, orthogonal_part, unit
from pipeline.geometry.knee import GIVEN_MM, KneeAnatomy, knee_anatomy
from pipeline.geometry.mesh import Float, TriangleMesh
from pipeline.geometry.phantom import PHANTOM_LABELS, PhantomTruth, phantom_labels, phantom_truth
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.kinematics.joint_coordinates import reference_from_moving, rigid
from tests.geometry.knees import MESHED, MIRROR, about, moved, phantom_knee, sphere

DATA = Path(__file__).resolve().parents[2].parent / "shared/data/knee_mr_a/labels.nrrd"
FLIP = np.array([-1.0, 1.0, 1.0])
Knee = Mapping[str, TriangleMesh]


@pytest.fixture(scope="module")
def knee() -> Knee:
    return phantom_knee()[0]


@pytest.fixture(scope="module")
def truth() -> PhantomTruth:
    return phantom_knee()[1]


@pytest.fixture(scope="module")
def found(knee: Knee) -> KneeAnatomy:
    return knee_anatomy(knee, 1.0, {})


def angles_deg(anatomy: KneeAnatomy) -> Float:
    return np.degrees(anatomy.scan[:3])


# --- against the phantom's truth; the tolerances are what 1.4 mm voxels and 45 mm of shaft reach, with some room


def test_axes_are_those_of_the_phantom(found: KneeAnatomy, truth: PhantomTruth) -> None:
    axes = {name: axis.direction for name, axis in found.axes.items()}
    assert angle_deg(axes["flexion_axis"], truth.flexion_axis) < 0.7
    assert angle_deg(axes["femoral_long_axis"], truth.femoral_shaft_axis) < 1.3
    assert angle_deg(axes["tibial_long_axis"], truth.tibial_shaft_axis) < 1.3
    for name, axis in found.axes.items():
        assert 0.1 < axis.uncertainty_deg < 5.0, name


def test_landmarks_are_those_of_the_phantom(found: KneeAnatomy, truth: PhantomTruth) -> None:
    limits_mm = {"condyle": 0.5, "plateau": 2.5, "epicondyle": 2.5}
    for name in ("condyle_centre", "plateau_centre", "epicondyle"):
        for side in ("medial", "lateral"):
            point, true = found.points[f"{side}_{name}"], truth.landmarks[f"{side}_{name}"]
            assert np.linalg.norm(point.position - true) < limits_mm[name.removesuffix("_centre")], f"{side} {name}"
            assert not point.given


def test_frames_are_those_of_the_phantom(found: KneeAnatomy, truth: PhantomTruth) -> None:
    for here, there, limit_mm in (
        (found.scan_from_femur, truth.scan_from_reference, 0.5),
        (found.scan_from_tibia, truth.scan_from_moving, 2.0),
    ):
        np.testing.assert_allclose(here[:3, :3].T @ here[:3, :3], np.eye(3), rtol=0, atol=1e-12)
        assert np.linalg.det(here[:3, :3]) == pytest.approx(1.0)
        assert np.linalg.norm(here[:3, 3] - there[:3, 3]) < limit_mm
    assert angle_deg(found.scan_from_femur[:3, 2], truth.scan_from_reference[:3, 2]) < 1.0


def test_the_scan_attitude_is_that_of_the_phantom(knee: Knee, truth: PhantomTruth) -> None:
    found = knee_anatomy(knee, 1.0, {}, "long_axis")
    flexion, varus, rotation = np.abs(angles_deg(found) - truth.scan_attitude[:3])
    assert flexion < 0.5
    assert varus < 0.8
    assert rotation < 2.0
    np.testing.assert_allclose(found.scan[3:], truth.scan_attitude[3:], rtol=0, atol=1.5)
    np.testing.assert_allclose(found.delta, found.axes["tibial_long_axis"].direction, rtol=0, atol=0)


def test_the_neutral_rule_makes_the_scan_the_neutral_varus(found: KneeAnatomy) -> None:
    assert found.scan.varus_rad == pytest.approx(0.0, abs=1e-12)
    assert found.delta @ found.axes["flexion_axis"].direction == pytest.approx(0.0, abs=1e-12)
    # in the sagittal plane nothing is changed
    axis, square = found.axes["tibial_long_axis"].direction, found.axes["flexion_axis"].direction
    np.testing.assert_allclose(found.delta, orthogonal_part(axis, square), rtol=0, atol=1e-12)


def test_the_moving_frame_stands_on_delta_whatever_it_is(knee: Knee) -> None:
    push = unit(np.array([0.1, -0.3, 0.95]))
    found = knee_anatomy(knee, 1.0, {}, push)
    np.testing.assert_allclose(found.scan_from_tibia[:3, 2], push, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.delta, push, rtol=0, atol=0)


def test_the_scan_attitude_takes_one_frame_to_the_other(found: KneeAnatomy) -> None:
    tibia = found.scan_from_femur @ reference_from_moving(found.scan)
    np.testing.assert_allclose(tibia, found.scan_from_tibia, rtol=0, atol=1e-10)


def test_every_sign_tells_the_declared_side(found: KneeAnatomy) -> None:
    assert len(found.signs) == 2
    assert all(sign.agrees for sign in found.signs)


# --- laws


def test_a_left_knee_is_the_mirror_image_of_a_right_one(knee: Knee, found: KneeAnatomy) -> None:
    left = knee_anatomy(moved(knee, MIRROR), -1.0, {})
    np.testing.assert_allclose(left.scan_from_femur, MIRROR @ found.scan_from_femur, rtol=0, atol=1e-9)
    np.testing.assert_allclose(left.scan_from_tibia, MIRROR @ found.scan_from_tibia, rtol=0, atol=1e-9)
    assert np.linalg.det(left.scan_from_tibia) == pytest.approx(-1.0)
    np.testing.assert_allclose(left.scan, found.scan, rtol=0, atol=1e-9)
    for name, point in found.points.items():
        np.testing.assert_allclose(left.points[name].position, point.position * FLIP, rtol=0, atol=1e-9)
    assert all(sign.agrees for sign in left.signs)


def test_a_moved_knee_has_moved_frames_and_the_same_attitude(knee: Knee, found: KneeAnatomy) -> None:
    motion = rigid(about(-20.0, 35.0, 70.0), np.array([150.0, -40.0, 60.0]))
    other = knee_anatomy(moved(knee, motion), 1.0, {})
    np.testing.assert_allclose(other.scan_from_femur, motion @ found.scan_from_femur, rtol=0, atol=1e-9)
    np.testing.assert_allclose(other.scan_from_tibia, motion @ found.scan_from_tibia, rtol=0, atol=1e-9)
    np.testing.assert_allclose(other.scan, found.scan, rtol=0, atol=1e-9)


def test_the_wrong_side_is_contradicted_by_every_sign(knee: Knee) -> None:
    wrong = knee_anatomy(moved(knee, MIRROR), 1.0, {})
    assert len(wrong.signs) == 2
    assert not any(sign.agrees for sign in wrong.signs)
    assert "medial of the tibia" in wrong.signs[0].sentence


# --- what may be missing


def test_without_a_patella_the_same_axes_are_found(knee: Knee, found: KneeAnatomy) -> None:
    without = knee_anatomy({name: mesh for name, mesh in knee.items() if name != "patella"}, 1.0, {})
    np.testing.assert_allclose(without.scan_from_femur, found.scan_from_femur, rtol=0, atol=0.05)
    np.testing.assert_allclose(without.scan_from_tibia, found.scan_from_tibia, rtol=0, atol=0.1)


def test_bones_alone_give_frames_but_no_sign(knee: Knee, found: KneeAnatomy) -> None:
    bare = knee_anatomy({name: knee[name] for name in ("femur", "tibia", "patella")}, 1.0, {})
    assert bare.signs == ()
    np.testing.assert_array_equal(bare.scan_from_tibia, found.scan_from_tibia)


def test_a_bone_without_shaft_is_named(knee: Knee) -> None:
    with pytest.raises(ValueError, match=r"the long axis of the tibia was not found \(fewer than 6"):
        knee_anatomy({**knee, "tibia": sphere(8.0, (30.0, -20.0, 60.0), fine=2)}, 1.0, {})


# --- given landmarks


def test_given_condyle_centres_are_the_flexion_axis(knee: Knee, truth: PhantomTruth) -> None:
    names = ("medial_condyle_centre", "lateral_condyle_centre")
    found = knee_anatomy(knee, 1.0, {name: truth.landmarks[name] for name in names})
    axis = found.axes["flexion_axis"]
    assert angle_deg(axis.direction, truth.flexion_axis) < 1e-6
    assert axis.method == "line through the given condyle centres"
    assert axis.uncertainty_deg == pytest.approx(np.degrees(np.arctan2(2.0 * GIVEN_MM, 46.0)))
    np.testing.assert_allclose(found.scan_from_femur[:3, 3], truth.scan_from_reference[:3, 3], rtol=0, atol=1e-9)
    assert found.points[names[0]].given
    assert not found.points["medial_epicondyle"].given


def test_given_hip_and_ankle_are_the_mechanical_axes(knee: Knee, found: KneeAnatomy, truth: PhantomTruth) -> None:
    knee_centre, plateau = found.scan_from_femur[:3, 3], found.scan_from_tibia[:3, 3]
    hip, ankle = knee_centre + np.array([20.0, 10.0, 420.0]), plateau - np.array([-15.0, 5.0, 380.0])
    given = knee_anatomy(knee, 1.0, {"femoral_head_centre": hip, "ankle_centre": ankle}, "long_axis")
    np.testing.assert_allclose(given.axes["femoral_long_axis"].direction, unit(hip - knee_centre), atol=1e-12)
    np.testing.assert_allclose(given.axes["tibial_long_axis"].direction, unit(plateau - ankle), atol=1e-12)
    np.testing.assert_allclose(given.delta, unit(plateau - ankle), atol=1e-12)
    assert given.axes["tibial_long_axis"].method == "from the joint to the given ankle centre"
    assert given.axes["tibial_long_axis"].uncertainty_deg < found.axes["tibial_long_axis"].uncertainty_deg


def test_the_hip_is_taken_before_the_shaft(knee: Knee, found: KneeAnatomy) -> None:
    centre = found.scan_from_femur[:3, 3]
    hip, shaft_mm = np.array([5.0, 0.0, 400.0]), np.array([0.0, 9.0, 90.0])
    both = {"femoral_head_centre": centre + hip, "femur_shaft_centre": centre + shaft_mm}
    given = knee_anatomy(knee, 1.0, both)
    assert given.axes["femoral_long_axis"].method == "from the joint to the given femoral head centre"
    shaft = knee_anatomy(knee, 1.0, {"femur_shaft_centre": both["femur_shaft_centre"]})
    np.testing.assert_allclose(shaft.axes["femoral_long_axis"].direction, unit(shaft_mm), atol=1e-12)


def test_given_plateau_centres_are_the_tibial_frame(knee: Knee, truth: PhantomTruth) -> None:
    names = ("medial_plateau_centre", "lateral_plateau_centre")
    given = {name: truth.landmarks[name] for name in names}
    found = knee_anatomy(knee, 1.0, given)
    middle = 0.5 * (given[names[0]] + given[names[1]])
    np.testing.assert_allclose(found.scan_from_tibia[:3, 3], middle, rtol=0, atol=1e-9)
    axis = found.axes["tibial_mediolateral_axis"]
    np.testing.assert_allclose(axis.direction, unit(given[names[1]] - given[names[0]]), rtol=0, atol=1e-12)
    assert axis.method == "line through the given plateau centres"


def test_a_hip_read_the_wrong_way_round_is_refused(knee: Knee, found: KneeAnatomy) -> None:
    """The hip of a knee 80 mm beside the middle of the scanner, with left and right, front and back exchanged."""
    beside = np.eye(4)
    beside[:3, 3] = [-80.0, 30.0, 0.0]
    hip = (found.scan_from_femur @ [0.0, 0.0, 420.0, 1.0])[:3] + beside[:3, 3]
    with pytest.raises(ValueError, match=r"femoral head centre lies .* deg off the shaft; is its file LPS or RAS"):
        knee_anatomy(moved(knee, beside), 1.0, {"femoral_head_centre": hip * [-1.0, -1.0, 1.0]})


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_flexion_axis_of_an_uneven_femur_is_as_uncertain_as_it_is_wrong(seed: int) -> None:
    spec = PhantomSpec(spacing_mm=(1.4, 1.4, 1.4), shaft_length_mm=45.0, roughness_mm=0.15, seed=seed)
    volume, true = phantom_labels(spec), phantom_truth(spec)
    settings = SurfaceSettings(triangles=4000)
    bones = ("femur", "tibia", "patella")
    meshes = {b: mask_to_mesh(volume.values == PHANTOM_LABELS[b], volume.lps_from_index, settings).mesh for b in bones}
    axis = knee_anatomy(meshes, 1.0, {}).axes["flexion_axis"]
    assert angle_deg(axis.direction, true.flexion_axis) < 2.5 * axis.uncertainty_deg
    assert axis.uncertainty_deg < 3.0


# --- a real knee


@pytest.fixture(scope="module")
def real() -> KneeAnatomy:
    if not DATA.is_file():
        pytest.skip("real knee knee_mr_a is not beside the checkout")
    volume = read_label_map(DATA.read_bytes(), "labels.nrrd").volume
    # every second to fourth voxel: about 1.4 mm, meshed in two seconds
    steps = [max(1, round(1.4 / size)) for size in volume.spacing_mm]
    values = volume.values[:: steps[0], :: steps[1], :: steps[2]]
    matrix = volume.lps_from_index @ np.diag([*map(float, steps), 1.0])
    settings = SurfaceSettings(triangles=4000)
    meshes = {name: mask_to_mesh(values == PHANTOM_LABELS[name], matrix, settings).mesh for name in MESHED}
    return knee_anatomy(meshes, 1.0, {})


def test_a_real_knee_is_a_right_knee_in_extension(real: KneeAnatomy) -> None:
    flexion, varus, rotation = angles_deg(real)
    assert -10.0 < flexion < 15.0
    assert varus == pytest.approx(0.0, abs=1e-9)
    assert abs(rotation) < 15.0
    assert len(real.signs) == 2
    assert all(sign.agrees for sign in real.signs)
    # patient space: lateral of a right knee is to the patient's right, proximal is up
    assert real.axes["flexion_axis"].direction[0] < -0.9
    assert real.axes["femoral_long_axis"].direction[2] > 0.95
    for axis in real.axes.values():
        assert np.isfinite(axis.direction).all()
        assert 0.0 < axis.uncertainty_deg < 10.0
