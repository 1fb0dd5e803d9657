"""Cartilage and menisci made from the bones of the phantom, whose true frames are known."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.adapters.mask_surface import SurfaceSettings, mask_to_mesh
from pipeline.geometry.cartilage import radial_surface
from pipeline.geometry.containment import contains
from pipeline.geometry.made_surfaces import (
    FILLER,
    KneeBones,
    MadeSurfaces,
    SurfaceBounds,
    SurfaceMask,
    anatomical_surfaces,
    joint_space_filler,
)
from pipeline.geometry.mesh import Float, TriangleMesh, merged, transformed
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels, phantom_truth
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.validation_objects import ball
from pipeline.kinematics.body_frames import in_frame

SPEC = PhantomSpec(spacing_mm=(1.0, 1.0, 1.0))
EVERY = frozenset(name for name in PHANTOM_LABELS if "tibial_c" in name or "menisc" in name) | {"femoral_cartilage"}
BOUNDS = SurfaceBounds()


@pytest.fixture(scope="module")
def bones() -> KneeBones:
    """The bare bones of the phantom in their own frames."""
    labels, truth = phantom_labels(SPEC), phantom_truth(SPEC)

    def mesh(name: str, frame: Float) -> TriangleMesh:
        inside = labels.values == PHANTOM_LABELS[name]
        return in_frame(mask_to_mesh(inside, labels.lps_from_index, SurfaceSettings(20_000)).mesh, frame)

    femur, tibia = mesh("femur", truth.scan_from_reference), mesh("tibia", truth.scan_from_moving)
    return KneeBones(femur, tibia, np.linalg.inv(truth.scan_from_moving) @ truth.scan_from_reference)


@pytest.fixture(scope="module")
def made(bones: KneeBones) -> MadeSurfaces:
    return anatomical_surfaces(bones, BOUNDS, EVERY)


def voxels(mask: SurfaceMask) -> Float:
    """(N, 3) centres of a mask's voxels in its frame."""
    index = np.argwhere(mask.inside)
    return np.asarray(index @ mask.frame_from_index[:3, :3].T + mask.frame_from_index[:3, 3])


def test_all_that_is_wanted_is_made_on_its_body(made: MadeSurfaces) -> None:
    assert set(made.masks) == EVERY
    assert {name for name, mask in made.masks.items() if mask.body == "reference"} == {"femoral_cartilage"}
    assert all(space.from_scan for space in made.spaces.values())


def test_cartilage_fills_the_joint_space_of_the_scan(made: MadeSurfaces) -> None:
    """The phantom's bones are two layers of cartilage and its play apart."""
    for space in made.spaces.values():
        assert space.femoral_mm + space.tibial_mm == pytest.approx(space.between_mm)
        assert space.between_mm == pytest.approx(2.0 * SPEC.cartilage_mm + SPEC.clearance_mm, abs=1.0)


def test_femoral_cartilage_is_as_thick_as_said_around_the_condyles(made: MadeSurfaces, bones: KneeBones) -> None:
    points = voxels(made.masks["femoral_cartilage"])
    outside = points[::7][~contains(bones.femur, points[::7])]
    for side, name in ((-1.0, "medial"), (1.0, "lateral")):
        for angle in (0.0, 60.0, 100.0):
            around = np.degrees(np.arctan2(-outside[:, 1], -outside[:, 2]))
            near = (np.abs(outside[:, 0] - side * 0.5 * SPEC.condyle_spacing_mm) < 3.0) & (np.abs(around - angle) < 4.0)
            radius = np.hypot(outside[near, 1], outside[near, 2])
            assert np.ptp(radius) == pytest.approx(made.spaces[name].femoral_mm, abs=0.9)


def test_a_bump_beside_the_joint_gets_no_cartilage(bones: KneeBones) -> None:
    """An epicondyle that faces away from the flexion axis is an island of the patch, and no part of it."""
    bump = TriangleMesh(ball(6.0).points + np.array([46.0, 24.0, 4.0]), ball(6.0).triangles)
    radial = radial_surface(merged([bones.femur, bump]))
    there = radial.raster.axes()[0] > 42.0
    assert np.isfinite(radial.radius_mm[there]).sum() > 100
    np.testing.assert_array_equal(radial.patch[there], 0.0)
    assert (radial.patch > 0.9).sum() > 5000


def test_nothing_is_made_inside_the_femur_of_the_scan(made: MadeSurfaces, bones: KneeBones) -> None:
    placed = transformed(bones.femur, bones.moving_from_reference)
    for name in sorted(EVERY - {"femoral_cartilage"}):
        points = voxels(made.masks[name])[::11]
        assert not contains(placed, points).any(), name


def test_menisci_keep_their_bounds_and_are_open_towards_the_eminence(made: MadeSurfaces) -> None:
    for side, name in ((-1.0, "medial"), (1.0, "lateral")):
        points = voxels(made.masks[f"{name}_meniscus"])
        shape = getattr(BOUNDS, name)
        across, along = side * points[:, 0], points[:, 1]
        assert across.min() > 0.0
        for low in (-12.0, 0.0, 12.0):
            column = points[(np.abs(along - low) < 0.3) & (across > np.percentile(across, 80))]
            assert len(column) == 0 or np.ptp(column[:, 2]) <= shape.height_mm + 5.0
        middle = np.abs(along - 0.5 * (along.min() + along.max())) < 2.0
        inner = across[middle].min()
        assert across.max() - inner <= max(shape.anterior_width_mm, shape.posterior_width_mm) + 1.0
        ends = np.abs(along - 0.5 * (along.min() + along.max())) > 0.6 * 0.5 * np.ptp(along)
        assert across[ends].min() < inner - 3.0  # horns reach farther in than the body: the shape of a C


def test_what_is_not_wanted_is_left_to_the_bodies(bones: KneeBones) -> None:
    only = anatomical_surfaces(bones, BOUNDS, frozenset({"medial_meniscus"}))
    assert set(only.masks) == {"medial_meniscus"}


def test_a_filler_lies_between_the_bones_and_no_higher_than_its_bound(bones: KneeBones) -> None:
    filler = joint_space_filler(bones, BOUNDS)
    assert set(filler.masks) == {FILLER}
    points = voxels(filler.masks[FILLER])
    assert not contains(transformed(bones.femur, bones.moving_from_reference), points[::29]).any()
    columns = filler.masks[FILLER].inside.sum(axis=2) * 0.5
    assert 2.0 < columns.max() <= BOUNDS.filler_mm + 1.5


def test_bones_too_far_apart_give_the_thickness_of_the_protocol_or_no_room(bones: KneeBones) -> None:
    away = np.eye(4)
    away[2, 3] = 9.0
    apart = KneeBones(bones.femur, bones.tibia, away @ bones.moving_from_reference)
    spaces = anatomical_surfaces(apart, BOUNDS, EVERY).spaces
    assert [space.from_scan for space in spaces.values()] == [False, False]
    assert {space.femoral_mm for space in spaces.values()} == {BOUNDS.default_thickness_mm}


def test_a_tibia_upside_down_is_refused(bones: KneeBones) -> None:
    upside_down = TriangleMesh(bones.tibia.points * [1.0, -1.0, -1.0] - [0.0, 0.0, 60.0], bones.tibia.triangles)
    with pytest.raises(ValueError, match="no plateau"):
        anatomical_surfaces(KneeBones(bones.femur, upside_down, bones.moving_from_reference), BOUNDS, EVERY)


def test_a_femur_without_condyles_is_refused(bones: KneeBones) -> None:
    above = TriangleMesh(bones.femur.points + np.array([0.0, 0.0, 100.0]), bones.femur.triangles)
    with pytest.raises(ValueError, match="no posterior condyles"):
        anatomical_surfaces(KneeBones(above, bones.tibia, bones.moving_from_reference), BOUNDS, EVERY)
