"""A parametric knee as a label map, with the exact answers to what the pipeline must find in it.

The knee is built as a right one in its reference frame (origin in the middle of the flexion axis) from implicit solids,
sampled at the voxel centres of a grid that stands in body axes (x to the patient's left, y posterior, z superior).
A left knee is the mirror image: the same numbers, read from the other side.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pipeline.geometry import phantom_femur, phantom_tibia
from pipeline.geometry.phantom_frames import (
    affine,
    body_from_reference,
    lps_from_body,
    moved,
    reference_from_moving,
    turned,
)
from pipeline.geometry.phantom_shapes import Bools, Float
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.phantom_tibia import Plateau, Tibia
from pipeline.geometry.volume import LabelVolume
from pipeline.records import Side

Labels = NDArray[np.uint8]

#: Label values of the phantom, those of ``configs/labels/phantom.yaml``.
PHANTOM_LABELS = {
    "femoral_cartilage": 1,
    "medial_tibial_cartilage": 2,
    "lateral_tibial_cartilage": 3,
    "patellar_cartilage": 4,
    "femur": 5,
    "tibia": 6,
    "patella": 7,
    "fibula": 8,
    "lateral_meniscus": 9,
    "medial_meniscus": 10,
}

#: What a loose voxel of cartilage becomes.
_BELOW = {
    "femoral_cartilage": "femur",
    "medial_tibial_cartilage": "tibia",
    "lateral_tibial_cartilage": "tibia",
    "patellar_cartilage": "patella",
}

#: Slices evaluated at once: small enough for the processor's cache, large enough to be worth a call.
_SLAB_SLICES = 8
#: Bone of the tibia stays this much farther from the condyles than the seat does.
_BONE_BELOW_SEAT_MM = 1.0
#: What rises above the seat by this much could be hit by parts of the femur other than the condyles.
_TALL_MM = 1.0
#: Space between tibia and fibula.
_TIBIOFIBULAR_GAP_MM = 1.0


def phantom_labels(spec: PhantomSpec) -> LabelVolume:
    """The label map of a phantom knee.

    Voxels belong to the structure their centre lies in; where two solids meet, the femoral side has priority over the
    tibial one. The border of the volume cuts the shafts of femur, tibia and fibula.

    Parameters
    ----------
    spec : PhantomSpec

    Returns
    -------
    LabelVolume
        uint8, values of :data:`PHANTOM_LABELS`; LPS millimetres.
    """
    body_from_index, shape = _grid(spec)
    values = np.zeros(shape, np.uint8)
    reference_from_index = body_from_reference(spec.side) @ body_from_index
    reference_from_index[:3] /= spec.scale
    for start in range(0, shape[2], _SLAB_SLICES):
        slab = values[:, :, start : start + _SLAB_SLICES]
        points = moved(reference_from_index, _slab_indices(slab.shape, start))
        slab[...] = labels_at(points, spec).reshape(slab.shape)
    _remove_islands(values)
    return LabelVolume(values, lps_from_body(spec) @ body_from_index)


def _remove_islands(values: Labels) -> None:
    """Keep one component (faces touching) of each structure, in place.

    Layers thinner than a voxel leave loose voxels at their edges: cartilage becomes bone there, else background.
    """
    boxes = ndimage.find_objects(values)
    for name, value in PHANTOM_LABELS.items():
        region = values[boxes[value - 1]]
        parts, count = ndimage.label(region == value)
        largest = int(np.argmax(np.bincount(parts.ravel(), minlength=count + 1)[1:])) + 1
        region[(parts > 0) & (parts != largest)] = PHANTOM_LABELS.get(_BELOW.get(name, ""), 0)


def labels_at(points: Float, spec: PhantomSpec) -> Labels:
    """Label (N,) of points (3, N) of the reference frame of a right knee at scale 1, scan pose."""
    tibia = phantom_tibia.tibia_of(spec)
    out = np.zeros(points.shape[1], np.uint8)
    moving_from_reference = np.asarray(np.linalg.inv(reference_from_moving(tibia.scan)), dtype=np.float64)
    in_moving = moved(moving_from_reference, points)
    near = in_moving[2] < 16.0
    out[near] = _tibial_labels(in_moving[:, near], tibia)
    near = points[2] > -spec.medial_radius_mm - spec.distal_radius_excess_mm
    femoral = _femoral_labels(points[:, near], spec)
    out[near] = np.where(femoral > 0, femoral, out[near])
    return out


def _femoral_labels(points: Float, spec: PhantomSpec) -> Labels:
    """Labels (N,) of femur, patella and their cartilage, points (3, N) in the reference frame."""
    out = np.zeros(points.shape[1], np.uint8)
    femur = phantom_femur.femur_field(points, spec)
    front = phantom_femur.near_patella(points)
    out[front] = _patellar_labels(points[:, front], femur[front])
    inside = femur < 0.0
    cartilage = phantom_femur.in_femoral_cartilage(points[:, inside], spec)
    out[inside] = np.where(cartilage, PHANTOM_LABELS["femoral_cartilage"], PHANTOM_LABELS["femur"])
    return out


def _patellar_labels(points: Float, femur: Float) -> Labels:
    """Labels (N,) of patella and its cartilage."""
    cartilage = phantom_femur.in_patellar_cartilage(points, femur)
    labels = np.where(cartilage, PHANTOM_LABELS["patellar_cartilage"], PHANTOM_LABELS["patella"])
    return np.where(phantom_femur.patella_field(points, femur) < 0.0, labels, 0).astype(np.uint8)


def _tibial_labels(points: Float, tibia: Tibia) -> Labels:
    """Labels (N,) of tibia, its cartilage, menisci and fibula, points (3, N) in the moving frame."""
    out = np.zeros(points.shape[1], np.uint8)
    tibia_field = phantom_tibia.tibia_field(points, tibia)
    _paint(out, tibia_field < 0.0, "tibia")
    near = phantom_tibia.near_fibula(points)
    fibula = (phantom_tibia.fibula_field(points[:, near]) < 0.0) & (tibia_field[near] > _TIBIOFIBULAR_GAP_MM)
    out[near] = np.where(fibula, PHANTOM_LABELS["fibula"], out[near])
    near = points[2] > -12.0
    out[near] = _seat_labels(points[:, near], tibia, out[near])
    return out


def _seat_labels(points: Float, tibia: Tibia, bone: Labels) -> Labels:
    """Labels (N,) near the plateau: cartilage and menisci added to the bone, the mould cut out of everything."""
    out = bone.copy()
    mould = phantom_tibia.mould_field(points, tibia)
    in_bone = bone == PHANTOM_LABELS["tibia"]
    out[in_bone & (mould < _BONE_BELOW_SEAT_MM)] = 0
    for name, half in (("medial", tibia.medial), ("lateral", tibia.lateral)):
        _paint(out, in_bone & phantom_tibia.in_tibial_cartilage(points, half, tibia), f"{name}_tibial_cartilage")
        meniscus = phantom_tibia.meniscus_field(points, half, tibia) < 0.0
        _paint(out, meniscus & (out == 0), f"{name}_meniscus")
    out[mould < 0.0] = 0
    tall = (out > 0) & (points[2] > _TALL_MM)
    out[tall] = np.where(phantom_tibia.in_the_way(points[:, tall], tibia), 0, out[tall])
    return out


def _paint(out: Labels, where: Bools, name: str) -> None:
    out[where] = PHANTOM_LABELS[name]


def _grid(spec: PhantomSpec) -> tuple[Float, tuple[int, int, int]]:
    """(4, 4) body_from_index and voxel counts of a grid that just holds the knee, symmetric about its middle in i."""
    tilt = turned(spec.grid_tilt_deg)
    corners = tilt.T @ body_from_reference(spec.side)[:3, :3] @ _extremes(spec) * spec.scale
    low, high = corners.min(axis=1), corners.max(axis=1)
    low[0], high[0] = -np.abs(corners[0]).max(), np.abs(corners[0]).max()
    margin = np.array([spec.margin_mm, spec.margin_mm, 0.0])
    spacing = np.asarray(spec.spacing_mm, dtype=np.float64)
    counts = np.ceil((high - low + 2 * margin) / spacing).astype(int) + 1
    origin = (low + high) / 2 - (counts - 1) / 2 * spacing
    shape = (int(counts[0]), int(counts[1]), int(counts[2]))
    return affine(tilt * spacing, tilt @ origin), shape


def _extremes(spec: PhantomSpec) -> Float:
    """Points (3, N) of the reference frame at scale 1 whose box holds the knee; the shafts end at their middle."""
    _, y, z = phantom_femur.PATELLA_CENTRE_MM
    depth_y, depth_z = phantom_femur.PATELLA_SEMI_AXES_MM[1:]
    width = spec.half_width_mm + 5.0
    top = phantom_femur.METAPHYSIS_TOP_MM + spec.shaft_length_mm
    bottom = -phantom_tibia.METAPHYSIS_BOTTOM_MM - spec.shaft_length_mm
    femoral = [*product((-width, width), (-spec.medial_radius_mm, y + depth_y), (0.0, z + depth_z)), (0.0, y, top)]
    tibial = [*product((-width, width), (-30.0, 26.0), (-50.0, 0.0)), *product((0.0, width), (-24.0, 13.0), (bottom,))]
    motion = reference_from_moving(phantom_tibia.tibia_of(spec).scan)
    return np.hstack([np.array(femoral).T, moved(motion, np.array(tibial).T)])


def _slab_indices(shape: tuple[int, ...], start: int) -> Float:
    """Voxel indices (3, N) of a slab of slices."""
    axes = [np.arange(shape[0]), np.arange(shape[1]), np.arange(start, start + shape[2])]
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")]).astype(np.float64)


@dataclass(frozen=True, eq=False)
class PhantomTruth:
    """What is exactly true of a phantom, in scan space (LPS mm), whatever its voxels.

    Attributes
    ----------
    side : "right" or "left"
    landmarks : dict of str to (3,) float64
        Condyle centres (on the flexion axis), epicondyles, plateau centres, contact points, tibial tuberosity,
        fibular head, patella, a point of each shaft's axis at the end of the field of view.
    scan_from_reference, scan_from_moving : (4, 4) float64
        Kinematic frames, x lateral, y anterior, z proximal; left-handed for a left knee.
    delta : (3,) float64
        Third axis of ``scan_from_moving``; here the axis of the tibial shaft.
    scan_attitude : (6,) float64
        Flexion, varus, internal rotation (deg), lateral, anterior, proximal (mm) of the scan.
    seat_attitude : (6,) float64
        The same of the stable pose at the scan's varus; but for the first number it holds for every flexion from
        0 to 120 deg. Exact without roughness.
    flexion_axis : (3,) float64
        Unit vector from medial to lateral.
    femoral_shaft_axis, tibial_shaft_axis : (3,) float64
        Unit vectors, pointing proximally.
    medial_radius_mm, lateral_radius_mm : float
        Radius of the posterior condyles to the cartilage surface, in their mid-planes.
    """

    side: Side
    landmarks: dict[str, Float]
    scan_from_reference: Float
    scan_from_moving: Float
    delta: Float
    scan_attitude: Float
    seat_attitude: Float
    flexion_axis: Float
    femoral_shaft_axis: Float
    tibial_shaft_axis: Float
    medial_radius_mm: float
    lateral_radius_mm: float


def phantom_truth(spec: PhantomSpec) -> PhantomTruth:
    """The exact landmarks, axes, frames and poses of a phantom, in scan space (LPS mm)."""
    tibia = phantom_tibia.tibia_of(spec)
    shift = np.asarray(tibia.scan.shift_mm) * spec.scale
    scan_from_reference = lps_from_body(spec) @ body_from_reference(spec.side)
    reference_from_tibia = reference_from_moving(tibia.scan)
    reference_from_tibia[:3, 3] *= spec.scale
    scan_from_moving = scan_from_reference @ reference_from_tibia
    attitude = np.array([*tibia.scan[:3], *shift])
    lean = np.deg2rad(spec.femoral_valgus_deg)
    return PhantomTruth(
        side=spec.side,
        landmarks=_in_scan(scan_from_reference, _femoral_landmarks(spec), spec.scale)
        | _in_scan(scan_from_moving, _tibial_landmarks(tibia), spec.scale),
        scan_from_reference=scan_from_reference,
        scan_from_moving=scan_from_moving,
        delta=scan_from_moving[:3, 2],
        scan_attitude=attitude,
        seat_attitude=attitude + np.array([0, 0, 0, 0, 0, spec.clearance_mm * spec.scale]),
        flexion_axis=scan_from_reference[:3, 0],
        femoral_shaft_axis=scan_from_reference[:3, :3] @ np.array([np.sin(lean), 0.0, np.cos(lean)]),
        tibial_shaft_axis=scan_from_moving[:3, 2],
        medial_radius_mm=spec.medial_radius_mm * spec.scale,
        lateral_radius_mm=spec.lateral_radius_mm * spec.scale,
    )


def _in_scan(scan_from_frame: Float, points: dict[str, tuple[float, ...]], scale: float) -> dict[str, Float]:
    return {
        name: np.asarray(scan_from_frame[:3, :3] @ np.array(point) * scale + scan_from_frame[:3, 3])
        for name, point in points.items()
    }


def _femoral_landmarks(spec: PhantomSpec) -> dict[str, tuple[float, ...]]:
    medial, lateral = phantom_femur.epicondyles_mm(spec)
    top = phantom_femur.METAPHYSIS_TOP_MM + spec.shaft_length_mm
    lean = float(np.tan(np.deg2rad(spec.femoral_valgus_deg)))
    return {
        "medial_condyle_centre": (-spec.half_spacing_mm, 0.0, 0.0),
        "lateral_condyle_centre": (spec.half_spacing_mm, 0.0, 0.0),
        "medial_epicondyle": medial,
        "lateral_epicondyle": lateral,
        "patella_centre": phantom_femur.PATELLA_CENTRE_MM,
        "femoral_shaft_end": (lean * top, phantom_femur.SHAFT_ANTERIOR_MM, top),
    }


def _tibial_landmarks(tibia: Tibia) -> dict[str, tuple[float, ...]]:
    bottom = -phantom_tibia.METAPHYSIS_BOTTOM_MM - tibia.spec.shaft_length_mm
    return {
        "medial_plateau_centre": _plateau_centre(tibia.medial),
        "lateral_plateau_centre": _plateau_centre(tibia.lateral),
        "medial_contact": tuple(tibia.medial.contact_mm),
        "lateral_contact": tuple(tibia.lateral.contact_mm),
        "tibial_tuberosity": phantom_tibia.TUBEROSITY_MM,
        "fibular_head": phantom_tibia.FIBULAR_HEAD_MM,
        "tibial_shaft_end": (0.0, 0.0, bottom),
    }


def _plateau_centre(half: Plateau) -> tuple[float, ...]:
    return (*half.centre_mm, float(half.contact_mm[2]))
