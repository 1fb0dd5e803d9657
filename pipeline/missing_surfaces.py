"""Contact surfaces that were not labelled, made from the bodies that were, and what there is to say of them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.mask_surface import SurfaceSettings, SurfaceTask, meshes_of
from pipeline.engine.stage import Finding, Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.geometry.cartilage import JointSpace
from pipeline.geometry.made_surfaces import (
    FILLER,
    KneeBones,
    MadeSurfaces,
    SurfaceBounds,
    SurfaceMask,
    anatomical_surfaces,
    joint_space_filler,
)
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.body_frames import in_frame
from pipeline.kinematics.joint_coordinates import JointCoordinates, reference_from_moving
from pipeline.records import Anatomy
from pipeline.suggestions import plain

Float = NDArray[np.float64]

#: What is done about surfaces that a case does not label.
Missing = Literal["make", "filler", "leave"]
#: Structures that can be made.
MAKEABLE = frozenset(
    (
        "femoral_cartilage",
        "medial_tibial_cartilage",
        "lateral_tibial_cartilage",
        "medial_meniscus",
        "lateral_meniscus",
    )
)
#: A made structure has at least so many triangles.
LEAST_TRIANGLES = 1000
#: A knee at rest is turned no farther than this; made surfaces are those of the nearest such pose (deg).
MOST_ROTATION_DEG = 12.0
#: A tibia that lies farther to one side than this is not at rest, and surfaces are made with it under the femur (mm).
#: Origins of frames are found within about 2 mm.
MOST_LATERAL_MM = 3.0


@dataclass(frozen=True, eq=False)
class Made:
    """Structure name -> closed mesh in scan space, the names on each body, and what there is to say."""

    meshes: dict[str, TriangleMesh]
    reference: tuple[str, ...]
    moving: tuple[str, ...]
    findings: Findings


NOTHING_MADE = Made({}, (), (), ())


@dataclass(frozen=True, eq=False)
class Request:
    """What is to be made on which bodies.

    Attributes
    ----------
    names : collection of str
        Structures that are missing.
    reference, moving : TriangleMesh
        Bodies of what is labelled, scan space.
    anatomy : Anatomy
    bounds : SurfaceBounds
    triangle_mm2 : float
        Area of a triangle of what is made, on average.
    filler : bool
        One joint-space filler instead of cartilage and menisci.
    """

    names: Collection[str]
    reference: TriangleMesh
    moving: TriangleMesh
    anatomy: Anatomy
    bounds: SurfaceBounds
    triangle_mm2: float
    filler: bool


def make_surfaces(request: Request, jobs: int) -> Made:
    """Make what is missing.

    Raises
    ------
    CaseRejected
        E-CON-02 when the bones do not allow it.
    """
    names = [name for name in request.names if name in MAKEABLE]
    if not names:
        return NOTHING_MADE
    coordinates, taken_to_rest = _at_rest(request.anatomy.scan_attitude)
    bones = _bones(request, coordinates)
    try:
        found = _masks(request, bones, names)
        meshes = _meshes(found, request, jobs)
    except ValueError as error:
        raise CaseRejected(
            "E-CON-02",
            f"Cartilage and menisci cannot be made from these bones: {error}.",
            "Label them, or set contact.missing_surfaces to leave.",
        ) from error
    sides = {body: tuple(n for n in meshes if found.masks[n].body == body) for body in ("reference", "moving")}
    return Made(meshes, sides["reference"], sides["moving"], _findings(meshes, found.spaces, taken_to_rest))


def _at_rest(scan_attitude: tuple[float, ...]) -> tuple[JointCoordinates, tuple[str, ...]]:
    """The pose that surfaces are made for, and in words how the scan differs from it.

    It is the scan's own, unless a knee does not lie so at rest: turned too far, or the tibia beside the femur. There
    the bones are nearest at a wall of the eminence, and what is made around them holds nothing.
    """
    flexion, varus, rotation, lateral, anterior, proximal = scan_attitude
    turned = float(np.clip(rotation, -MOST_ROTATION_DEG, MOST_ROTATION_DEG))
    centred = lateral if abs(lateral) <= MOST_LATERAL_MM else 0.0
    words = []
    if turned != rotation:
        way = "in" if rotation > 0 else "out"
        words.append(f"turned {abs(rotation):.0f} deg {way}wardly (at rest at most {MOST_ROTATION_DEG:.0f} deg)")
    if centred != lateral:
        way = "lateral" if lateral > 0 else "medial"
        words.append(f"{abs(lateral):.1f} mm too far to {way} (at rest within {MOST_LATERAL_MM:.0f} mm)")
    flexion_rad, varus_rad, turned_rad = (float(np.radians(angle)) for angle in (flexion, varus, turned))
    return JointCoordinates(flexion_rad, varus_rad, turned_rad, centred, anterior, proximal), tuple(words)


def _bones(request: Request, coordinates: JointCoordinates) -> KneeBones:
    """Both bodies in their frames, and the pose that surfaces are made for."""
    reference, moving = (
        in_frame(body, np.asarray(frame))
        for body, frame in (
            (request.reference, request.anatomy.scan_from_reference),
            (request.moving, request.anatomy.scan_from_moving),
        )
    )
    moving_from_reference: Float = np.linalg.inv(reference_from_moving(coordinates)).astype(np.float64)
    return KneeBones(reference, moving, moving_from_reference)


def _masks(request: Request, bones: KneeBones, names: Collection[str]) -> MadeSurfaces:
    if request.filler:
        return joint_space_filler(bones, request.bounds)
    return anatomical_surfaces(bones, request.bounds, frozenset(names))


def _meshes(found: MadeSurfaces, request: Request, jobs: int) -> dict[str, TriangleMesh]:
    """A closed surface around each mask, in scan space."""
    tasks = [_task(mask, request.anatomy, request.triangle_mm2) for mask in found.masks.values()]
    meshes: dict[str, TriangleMesh] = {}
    for name, result in zip(found.masks, meshes_of(tasks, jobs), strict=True):
        if isinstance(result, ValueError):
            raise ValueError(f"the {name.replace('_', ' ')} has no closed surface ({result})") from result
        meshes[name] = result.mesh
    return meshes


def _task(mask: SurfaceMask, anatomy: Anatomy, triangle_mm2: float) -> SurfaceTask:
    frame = anatomy.scan_from_reference if mask.body == "reference" else anatomy.scan_from_moving
    settings = SurfaceSettings(triangles=max(LEAST_TRIANGLES, round(_area_mm2(mask) / triangle_mm2)))
    return SurfaceTask(mask.inside, np.asarray(frame) @ mask.frame_from_index, settings, np.zeros_like(mask.inside))


def _area_mm2(mask: SurfaceMask) -> float:
    """Area of a mask: that of its voxel faces is one and a half times that of a surface in any direction."""
    spacing = np.linalg.norm(mask.frame_from_index[:3, :3], axis=0)
    faces = (np.count_nonzero(np.diff(mask.inside, axis=axis)) * np.prod(np.delete(spacing, axis)) for axis in range(3))
    return float(sum(faces)) / 1.5


def _findings(meshes: Collection[str], spaces: dict[str, JointSpace], taken_to_rest: tuple[str, ...]) -> Findings:
    words = ", ".join(plain(name) for name in meshes)
    apart = " and ".join(f"{space.between_mm:.1f} mm apart {name}ly" for name, space in spaces.items())
    pose = "At a pose of rest" if taken_to_rest else "At the scan pose"
    out = [
        Finding(
            "N-CON-02",
            Severity.NOTE,
            f"Made from the bones, not seen in the scan: {words}. {pose} the bones are {apart}.",
        )
    ]
    if not all(space.from_scan for space in spaces.values()):
        message = f"The bones are {apart}, which is no joint space: made cartilage has the protocol's thickness."
        out.append(Finding("W-CON-02", Severity.REVIEW, message))
    if taken_to_rest:
        message = (
            f"The scan does not show a knee at rest: the tibia lies {' and '.join(taken_to_rest)}. "
            "Cartilage and menisci were made for the nearest pose of rest."
        )
        out.append(Finding("W-CON-03", Severity.REVIEW, message))
    return tuple(out)


def filled_in(names: Collection[str], made: Made) -> tuple[str, ...]:
    """Of some missing structures those that were made, or all of them where a filler stands for them."""
    if FILLER in made.meshes:
        return tuple(name for name in names if name in MAKEABLE)
    return tuple(name for name in names if name in made.meshes)
