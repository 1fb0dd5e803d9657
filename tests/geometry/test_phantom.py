"""The phantom is a knee, is what its truth says, and rests where it says."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels, phantom_truth
from pipeline.geometry.phantom_femur import femur_field
from pipeline.geometry.phantom_frames import moved, reference_from_moving
from pipeline.geometry.phantom_spec import RANGES, PhantomSpec
from pipeline.geometry.phantom_tibia import tibia_of
from pipeline.geometry.volume import LabelVolume
from pipeline.kinematics.joint_coordinates import joint_coordinates
from pipeline.records import Side
from tests.geometry.height_map_seat import Body, body_of, lower_surface, resting_offset, top_points, travel_mm

Float = NDArray[np.float64]

SQUARE = (0.0, 0.0, 0.0)
SPEC = PhantomSpec(spacing_mm=(1.0, 1.0, 1.0), shaft_length_mm=20.0, grid_tilt_deg=SQUARE)
COARSE = replace(SPEC, spacing_mm=(1.6, 1.6, 1.6))
BONES = ("femur", "tibia", "patella", "fibula")
FEMORAL = ("femur", "femoral_cartilage")
SEAT = ("medial_tibial_cartilage", "lateral_tibial_cartilage", "medial_meniscus", "lateral_meniscus")


@pytest.fixture(scope="module")
def volume() -> LabelVolume:
    return phantom_labels(SPEC)


@pytest.fixture(scope="module")
def coarse() -> LabelVolume:
    return phantom_labels(COARSE)


def mask(volume: LabelVolume, *names: str) -> NDArray[np.bool_]:
    return np.isin(volume.values, [PHANTOM_LABELS[name] for name in names])


def lps_mm(volume: LabelVolume, *names: str) -> Float:
    """Voxel centres (N, 3) of structures."""
    index = np.argwhere(mask(volume, *names))
    return np.asarray(index @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3])


def volumes_mm3(volume: LabelVolume) -> Float:
    """Volume of each structure, in the order of the label values."""
    count = np.bincount(volume.values.ravel().astype(np.int64), minlength=11)[1:]
    return np.asarray(count * np.prod(volume.spacing_mm))


def label_at(volume: LabelVolume, points: Float) -> NDArray[Any]:
    """Label of the voxel that each LPS point (N, 3) lies in."""
    inverse = np.linalg.inv(volume.lps_from_index)
    index = np.rint(points @ inverse[:3, :3].T + inverse[:3, 3]).astype(int)
    return np.asarray(volume.values[tuple(index.T)])


@pytest.mark.parametrize("name", PHANTOM_LABELS)
def test_every_structure_is_one_piece(volume: LabelVolume, name: str) -> None:
    assert ndimage.label(mask(volume, name))[1] == 1


def test_no_other_label_occurs(volume: LabelVolume) -> None:
    assert set(np.unique(volume.values)) == {0, *PHANTOM_LABELS.values()}


@pytest.mark.parametrize(("side", "lateral_is"), [("right", -1.0), ("left", 1.0)])
def test_structures_lie_where_a_clinician_expects_them(side: Side, lateral_is: float) -> None:
    volume = phantom_labels(replace(COARSE, side=side))
    middle = {name: lps_mm(volume, name).mean(axis=0) for name in PHANTOM_LABELS}
    assert lateral_is * (middle["lateral_meniscus"] - middle["medial_meniscus"])[0] > 30.0
    assert lateral_is * (middle["fibula"] - middle["tibia"])[0] > 20.0
    assert (middle["patella"] - middle["femur"])[1] < -20.0
    assert (middle["fibula"] - middle["tibia"])[1] > 5.0
    assert (middle["femur"] - middle["tibia"])[2] > 50.0
    assert np.linalg.det(volume.lps_from_index[:3, :3]) > 0.0


def test_a_left_knee_is_the_mirror_image_of_a_right_one(coarse: LabelVolume) -> None:
    left = phantom_labels(replace(COARSE, side="left"))
    np.testing.assert_array_equal(left.values, coarse.values[::-1])
    np.testing.assert_array_equal(left.lps_from_index, coarse.lps_from_index)


def test_placement_changes_the_header_only(coarse: LabelVolume) -> None:
    spec = replace(COARSE, placement_deg=(25.0, -40.0, 110.0), placement_mm=(-30.0, 200.0, 900.0))
    placed = phantom_labels(spec)
    np.testing.assert_array_equal(placed.values, coarse.values)
    motion = placed.lps_from_index @ np.linalg.inv(coarse.lps_from_index)
    np.testing.assert_allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(motion[:3, :3]) == pytest.approx(1.0)
    still, gone = phantom_truth(COARSE), phantom_truth(spec)
    np.testing.assert_allclose(gone.scan_from_moving, motion @ still.scan_from_moving, atol=1e-9)
    for name, point in still.landmarks.items():
        np.testing.assert_allclose(gone.landmarks[name], motion[:3, :3] @ point + motion[:3, 3], atol=1e-9)


def test_an_oblique_grid_and_flat_voxels_show_the_same_knee(volume: LabelVolume) -> None:
    oblique = phantom_labels(replace(SPEC, grid_tilt_deg=(12.0, -9.0, 20.0), spacing_mm=(0.9, 0.8, 1.2)))
    off_axis = oblique.lps_from_index[:3, :3] / oblique.spacing_mm
    assert np.abs(off_axis).max() < 0.99
    joint = [PHANTOM_LABELS[name] - 1 for name in ("patella", "femoral_cartilage", *SEAT)]
    np.testing.assert_allclose(volumes_mm3(oblique)[joint], volumes_mm3(volume)[joint], rtol=0.04)
    for name in ("patella", *SEAT):
        apart = lps_mm(oblique, name).mean(axis=0) - lps_mm(volume, name).mean(axis=0)
        assert np.linalg.norm(apart) < 0.5  # half a voxel: a thin sheet along the square grid can be off by that


def test_volumes_converge_with_the_voxels() -> None:
    # femur, tibia and fibula end at the border, which lies on the grid
    closed = [value - 1 for name, value in PHANTOM_LABELS.items() if name not in ("femur", "tibia", "fibula")]
    # an oblique grid: a sheet along a square one gains or loses whole layers
    spec = PhantomSpec(shaft_length_mm=5.0)
    coarse, middle, fine = (
        volumes_mm3(phantom_labels(replace(spec, spacing_mm=(size,) * 3)))[closed] for size in (2.4, 1.1, 0.75)
    )
    coarse_error, error = np.abs(coarse / fine - 1.0), np.abs(middle / fine - 1.0)
    assert error.max() < 0.02
    assert error.mean() < coarse_error.mean() / 2


def test_scale_acts_on_everything() -> None:
    small = phantom_labels(replace(COARSE, scale=0.8, margin_mm=4.0))
    spacing = (1.6 / 0.8,) * 3
    same = phantom_labels(replace(COARSE, spacing_mm=spacing, margin_mm=5.0))
    np.testing.assert_array_equal(small.values, same.values)
    one, other = phantom_truth(replace(COARSE, scale=0.8)), phantom_truth(COARSE)
    np.testing.assert_allclose(one.landmarks["tibial_tuberosity"], 0.8 * other.landmarks["tibial_tuberosity"])


def test_the_border_cuts_the_shafts_and_nothing_else(volume: LabelVolume) -> None:
    first, last = volume.values[:, :, 0], volume.values[:, :, -1]
    assert set(np.unique(last)) == {0, PHANTOM_LABELS["femur"]}
    assert set(np.unique(first)) == {0, PHANTOM_LABELS["tibia"], PHANTOM_LABELS["fibula"]}
    for axis in (0, 1):
        assert not volume.values.take([0, -1], axis=axis).any()


@pytest.mark.parametrize("side", ["right", "left"])
def test_frames_and_attitude_agree_with_the_joint_coordinates(side: Side) -> None:
    spec = replace(SPEC, side=side, scale=1.1, flexion_deg=14.0, varus_deg=-2.0, internal_rotation_deg=-6.0)
    truth = phantom_truth(replace(spec, placement_deg=(5.0, 6.0, 7.0), placement_mm=(1.0, 2.0, 3.0)))
    pose = joint_coordinates(np.linalg.inv(truth.scan_from_reference) @ truth.scan_from_moving)
    np.testing.assert_allclose([*np.rad2deg(pose[:3]), *pose[3:]], truth.scan_attitude, atol=1e-9)
    np.testing.assert_allclose(truth.scan_attitude[:3], [14.0, -2.0, -6.0], atol=1e-12)
    hand = 1.0 if side == "right" else -1.0
    assert np.linalg.det(truth.scan_from_reference) == pytest.approx(hand)
    assert np.linalg.det(truth.scan_from_moving) == pytest.approx(hand)


@pytest.mark.parametrize("compartment", ["medial", "lateral"])
def test_posterior_condyles_are_circles_about_the_flexion_axis(volume: LabelVolume, compartment: str) -> None:
    truth = phantom_truth(SPEC)
    centre = truth.landmarks[f"{compartment}_condyle_centre"]
    radius = getattr(truth, f"{compartment}_radius_mm")
    anterior, proximal = truth.scan_from_reference[:3, 1], truth.scan_from_reference[:3, 2]
    along = np.arange(0.0, 30.0, 0.05)
    found = []
    for angle in np.deg2rad(np.arange(5.0, 140.0, 5.0)):
        ray = centre + along[:, None] * (-np.sin(angle) * anterior - np.cos(angle) * proximal)
        found.append(along[label_at(volume, ray) == PHANTOM_LABELS["femoral_cartilage"]].max())
    assert np.mean(found) == pytest.approx(radius, abs=0.15)
    assert np.std(found) < 0.45


def test_the_distal_condyle_is_flatter_than_the_posterior_one() -> None:
    spec = PhantomSpec()
    distal = np.array([[23.0, 23.0], [0.0, 20.0], [-20.5, 8.0 - np.sqrt(28.5**2 - 20.0**2)]])
    np.testing.assert_allclose(femur_field(distal, spec), 0.0, atol=0.02)


@pytest.mark.parametrize(("bone", "axis"), [("femur", "femoral_shaft_axis"), ("tibia", "tibial_shaft_axis")])
def test_shafts_run_along_their_axes(volume: LabelVolume, bone: str, axis: str) -> None:
    truth = phantom_truth(SPEC)
    slices = range(-18, 0) if bone == "femur" else range(2, 18)
    index = [np.argwhere(volume.values[:, :, k] == PHANTOM_LABELS[bone]).mean(axis=0) for k in slices]
    deep = [k % volume.values.shape[2] for k in slices]
    middle = np.column_stack([index, deep]) @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3]
    end = truth.landmarks["femoral_shaft_end" if bone == "femur" else "tibial_shaft_end"]
    direction = getattr(truth, axis)
    assert np.linalg.norm(np.cross(middle - end, direction), axis=1).max() < 0.25
    assert direction[2] > 0.9


@pytest.mark.parametrize(
    ("landmark", "structure"),
    [("medial_epicondyle", "femur"), ("lateral_epicondyle", "femur"), ("tibial_tuberosity", "tibia")],
)
def test_landmarks_lie_on_their_bone(volume: LabelVolume, landmark: str, structure: str) -> None:
    surface = mask(volume, structure) & ~ndimage.binary_erosion(mask(volume, structure))
    index = np.argwhere(surface)
    points = index @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3]
    assert cKDTree(points).query(phantom_truth(SPEC).landmarks[landmark])[0] < 1.6


@pytest.mark.parametrize("compartment", ["medial", "lateral"])
def test_the_scan_is_in_contact_in_both_compartments(volume: LabelVolume, compartment: str) -> None:
    femoral = cKDTree(lps_mm(volume, "femoral_cartilage"))
    seat = lps_mm(volume, f"{compartment}_tibial_cartilage", f"{compartment}_meniscus")
    assert np.min(femoral.query(seat)[0]) <= np.linalg.norm(volume.spacing_mm)
    contact = phantom_truth(SPEC).landmarks[f"{compartment}_contact"]
    assert femoral.query(contact)[0] < 1.0
    assert cKDTree(seat).query(contact)[0] < 1.0


@pytest.mark.parametrize("name", ["medial_meniscus", "lateral_meniscus"])
def test_menisci_are_wedges_open_towards_the_spines(volume: LabelVolume, name: str) -> None:
    truth = phantom_truth(SPEC)
    inverse = np.linalg.inv(truth.scan_from_moving)
    x, y, z = (lps_mm(volume, name) @ inverse[:3, :3].T + inverse[:3, 3]).T
    contact = inverse[:3, :3] @ truth.landmarks[name.replace("meniscus", "contact")] + inverse[:3, 3]
    assert np.abs(y[np.abs(x) < np.abs(contact[0])] - contact[1]).min() > 7.0
    body = np.abs(y - contact[1]) < 3.0
    outwards = np.abs(x) - np.abs(contact[0])
    rim, free_edge = (float(np.ptp(z[body & (np.abs(outwards - place) < 1.0)])) for place in (12.0, 7.0))
    assert 4.0 < rim < 7.5
    assert free_edge < rim - 1.5


@pytest.mark.parametrize("spec", [PhantomSpec(), PhantomSpec(varus_deg=-2.0, crown_mm=7.0, meniscus_height_mm=8.0)])
def test_the_seat_stays_clear_of_the_femur_by_the_clearance_all_through_flexion(spec: PhantomSpec) -> None:
    volume = phantom_labels(replace(spec, spacing_mm=(1.2, 1.2, 1.2), shaft_length_mm=5.0))
    inverse = np.linalg.inv(phantom_truth(spec).scan_from_moving)
    body = (lps_mm(volume, "tibia", *SEAT) @ inverse[:3, :3].T + inverse[:3, 3]).T
    tibia = tibia_of(spec)
    for flexion_deg in (0.0, 20.0, 50.0, 90.0, 120.0):
        motion = reference_from_moving(tibia.scan._replace(flexion_deg=flexion_deg))
        assert femur_field(moved(motion, body), spec).min() >= spec.clearance_mm - 0.02
        motion[:3, 3] += motion[:3, 2] * (spec.clearance_mm + 0.8)
        assert femur_field(moved(motion, body), spec).min() < 0.0


@dataclass(frozen=True, eq=False)
class Pushed:
    """A knee's femur and the top of its tibial side, each in its own frame, and what should come out."""

    femur: Body
    points: Float
    seat_attitude: Float

    @property
    def seat(self) -> Float:
        """Lateral and anterior (mm) and rotation (deg) of the stable pose."""
        return np.asarray(self.seat_attitude[[3, 4, 2]])


def pushed(side: Side) -> Pushed:
    spec = PhantomSpec(side=side, spacing_mm=(0.8, 0.8, 0.8), shaft_length_mm=5.0)
    volume, truth = phantom_labels(spec), phantom_truth(spec)
    femur = body_of(mask(volume, *FEMORAL), volume.lps_from_index, truth.scan_from_reference)
    tibia = body_of(mask(volume, "tibia", *SEAT), volume.lps_from_index, truth.scan_from_moving)
    return Pushed(femur, top_points(tibia), truth.seat_attitude)


@pytest.fixture(scope="module")
def right() -> Pushed:
    return pushed("right")


def check_rests_at_seat(knee: Pushed, flexion_deg: float) -> None:
    surface = lower_surface(knee.femur, flexion_deg, float(knee.seat_attitude[1]))
    # a label map shows each of the two surfaces to half a voxel
    assert travel_mm(surface, knee.points, knee.seat) == pytest.approx(knee.seat_attitude[5], abs=0.5)
    for start in ((2.0, 2.0, 3.0), (-2.0, -2.0, -3.0)):
        rest = resting_offset(surface, knee.points, knee.seat + np.array(start))
        np.testing.assert_array_less(np.abs(rest - knee.seat), [0.7, 1.0, 1.6])


@pytest.mark.parametrize("flexion_deg", [0.0, 30.0, 60.0, 90.0, 120.0])
def test_pushed_from_around_it_comes_to_rest_at_its_seat(right: Pushed, flexion_deg: float) -> None:
    check_rests_at_seat(right, flexion_deg)


def test_a_left_knee_comes_to_rest_at_the_same_seat() -> None:
    check_rests_at_seat(pushed("left"), 45.0)


@pytest.mark.parametrize(("flexion_deg", "varus_deg"), [(0.0, -4.0), (60.0, -4.0), (60.0, 4.0), (120.0, 4.0)])
def test_it_rests_near_its_seat_when_one_compartment_is_lifted(
    right: Pushed, flexion_deg: float, varus_deg: float
) -> None:
    rest = resting_offset(lower_surface(right.femur, flexion_deg, varus_deg), right.points, right.seat)
    np.testing.assert_array_less(np.abs(rest - right.seat), [3.0, 4.0, 10.0])


def test_unevenness_is_seeded_and_leaves_a_knee() -> None:
    rough = replace(COARSE, roughness_mm=0.5, seed=3)
    first, again = phantom_labels(rough), phantom_labels(rough)
    other, smooth = phantom_labels(replace(rough, seed=4)), phantom_labels(COARSE)
    np.testing.assert_array_equal(first.values, again.values)
    assert (first.values != other.values).any()
    np.testing.assert_allclose(volumes_mm3(first), volumes_mm3(smooth), rtol=0.25)
    bones = [PHANTOM_LABELS[name] - 1 for name in BONES]
    np.testing.assert_allclose(volumes_mm3(first)[bones], volumes_mm3(smooth)[bones], rtol=0.04)


@pytest.mark.parametrize("end", [0, 1])
@pytest.mark.parametrize(
    "name", [name for name in RANGES if name not in ("spacing_mm", "placement_mm", "shaft_length_mm")]
)
def test_every_number_may_take_the_ends_of_its_range(name: str, end: int) -> None:
    value: Any = RANGES[name][end]
    value = (value,) * 3 if name.endswith(("placement_deg", "tilt_deg")) else value
    spec = replace(SPEC, spacing_mm=(2.5, 2.5, 2.5), shaft_length_mm=5.0, **{name: value})
    assert volumes_mm3(phantom_labels(spec)).min() > 100.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"side": "both"}, "side: expected right or left, got 'both'"),
        ({"scale": 3.0}, r"scale: expected 0.7 to 1.4, got 3.0"),
        ({"crown_mm": float("nan")}, "crown_mm: expected 5 to 15, got nan"),
        ({"spacing_mm": (1.0, 0.0, 1.0)}, "spacing_mm: expected 0.2 to 5, got 0.0"),
        ({"seed": -1}, "seed: expected 0 or more, got -1"),
        ({"flexion_deg": 90.0}, "flexion_deg: expected 0 to 30, got 90.0"),
    ],
)
def test_numbers_that_make_no_knee_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PhantomSpec(**change)
