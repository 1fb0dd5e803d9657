"""Anatomy of a knee from its meshes: landmarks, Grood-Suntay frames, delta and the scan's own attitude.

Femoral frame: x along the axis of the posterior condyles (lateral), z the part of the long axis orthogonal to it
(proximal), y anterior; origin half-way between the condyle centres. Tibial frame: z along the long axis (proximal),
x along the line of the plateau centres as far as it is orthogonal to z, y anterior; origin half-way between the
plateau centres. Where landmarks of the hip or ankle were given, the mechanical axes take the place of the shafts'.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.condyles import CondyleAxis, condyle_axis
from pipeline.geometry.cross_sections import volume_centroid
from pipeline.geometry.directions import angle_deg, orthogonal_part, smallest_turn, unit
from pipeline.geometry.knee_side import SideSign, side_signs
from pipeline.geometry.long_axis import LongAxis, long_axis
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.plateau import Plateau, plateau_centres
from pipeline.kinematics.joint_coordinates import JointCoordinates, joint_coordinates, rigid

Float = NDArray[np.float64]
DeltaRule = Literal["neutral", "long_axis"]

#: One standard deviation of a landmark that a person placed, mm.
GIVEN_MM = 1.0

#: A mechanical axis is within 8 deg of the shaft; coordinates read the wrong way round are farther off than this.
GIVEN_AXIS_DEG = 20.0

#: Landmarks a user may give, by name.
KNOWN_LANDMARKS = (
    "femoral_head_centre",
    "femur_shaft_centre",
    "medial_condyle_centre",
    "lateral_condyle_centre",
    "medial_epicondyle",
    "lateral_epicondyle",
    "medial_plateau_centre",
    "lateral_plateau_centre",
    "tibia_shaft_centre",
    "ankle_centre",
)


@dataclass(frozen=True, eq=False)
class Point:
    """A landmark: position (3,) in scan space and one standard deviation, mm; given by the user or found."""

    position: Float
    uncertainty_mm: float
    given: bool


@dataclass(frozen=True, eq=False)
class Axis:
    """A direction (3,) in scan space, one standard deviation of its angle, and how it was got."""

    direction: Float
    uncertainty_deg: float
    method: str

    def reversed(self) -> Axis:
        """The same line, the other way."""
        return Axis(-self.direction, self.uncertainty_deg, self.method)


@dataclass(frozen=True, eq=False)
class KneeAnatomy:
    """Everything known of a knee; vectors and frames in scan space (LPS mm).

    Attributes
    ----------
    points : dict of str to Point
    axes : dict of str to Axis
        ``flexion_axis`` and ``tibial_mediolateral_axis`` (medial to lateral), ``femoral_long_axis`` and
        ``tibial_long_axis`` (proximal).
    scan_from_femur, scan_from_tibia : (4, 4) float64
        Kinematic frames; left-handed for a left knee.
    delta : (3,) float64
    scan : JointCoordinates
        Attitude and found coordinates of the scan itself.
    signs : tuple of SideSign
    """

    points: dict[str, Point]
    axes: dict[str, Axis]
    scan_from_femur: Float
    scan_from_tibia: Float
    delta: Float
    scan: JointCoordinates
    signs: tuple[SideSign, ...]


def knee_anatomy(
    structures: Mapping[str, TriangleMesh],
    handed: float,
    given: Mapping[str, Float],
    delta: Float | DeltaRule = "neutral",
) -> KneeAnatomy:
    """Landmarks, frames and attitude of a knee.

    Parameters
    ----------
    structures : mapping of str to TriangleMesh
        At least ``femur`` and ``tibia``; ``patella``, ``fibula``, cartilage and menisci help to orient it.
    handed : float
        +1 for a right knee, -1 for a left one.
    given : mapping of str to (3,) float64
        Landmarks that replace what would be found; names of KNOWN_LANDMARKS.
    delta : (3,) float64, or "neutral", or "long_axis"
        Direction of the push in scan space, or the rule that finds it (see :func:`delta_of`).

    Raises
    ------
    ValueError
        When an axis or a surface cannot be found; the message says which.
    """
    femur, tibia = structures["femur"], structures["tibia"]
    upward = unit(volume_centroid(femur) - volume_centroid(tibia))
    femur_shaft, tibia_shaft = _shaft("femur", femur, upward), _shaft("tibia", tibia, -upward)
    rough = _rough_axes(structures, femur_shaft, handed)
    with _named("the posterior condyles of the femur were not found"):
        condyles = condyle_axis(femur, rough)
    with _named("the tibial plateau was not found"):
        plateau = plateau_centres(tibia, _rows(-tibia_shaft.direction, rough[0], handed))
    points = _points(condyles, plateau, femur_shaft, tibia_shaft, femur)
    points.update({name: Point(position, GIVEN_MM, given=True) for name, position in given.items()})
    axes = _chosen_axes(points, condyles, plateau, (femur_shaft, tibia_shaft))
    push = delta_of(delta, axes) if isinstance(delta, str) else delta
    return _assembled(points, axes, handed, push, side_signs(structures, rough[0]))


def delta_of(rule: DeltaRule, axes: Mapping[str, Axis]) -> Float:
    """Direction of the push (3,), found by a rule.

    ``long_axis`` is the tibial long axis, as the paper has it. ``neutral`` is the same with its coronal slope set
    square to the flexion axis at the scan pose, so that the scan is the neutral varus: there both compartments rest,
    and a few degrees away only one can touch. A joint line is oblique to the mechanical axis by about 3 deg, and the
    coronal slope of a short shaft is uncertain by more than that.
    """
    axis = axes["tibial_long_axis"].direction
    return axis if rule == "long_axis" else orthogonal_part(axis, axes["flexion_axis"].direction)


@contextmanager
def _named(what: str) -> Iterator[None]:
    """Say in the words of anatomy what a failed fit means."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{what} ({error})") from error


def _shaft(name: str, bone: TriangleMesh, away: Float) -> LongAxis:
    with _named(f"the long axis of the {name} was not found"):
        return long_axis(bone, away)


def _rough_axes(structures: Mapping[str, TriangleMesh], femur_shaft: LongAxis, handed: float) -> Float:
    """Rows lateral, anterior, proximal: the patella lies in front; without it, the shaft in front of the condyles."""
    proximal, femur = femur_shaft.direction, structures["femur"]
    along = femur.points @ proximal
    epiphysis = femur.points[along < along.min() + 45.0].mean(axis=0)
    front = volume_centroid(structures["patella"]) if "patella" in structures else femur_shaft.far_centre
    anterior = orthogonal_part(front - epiphysis, proximal)
    return np.stack([handed * np.cross(anterior, proximal), anterior, proximal])


def _rows(proximal: Float, lateral: Float, handed: float) -> Float:
    """Rows lateral, anterior, proximal with z exact and x as near as can be."""
    x = orthogonal_part(lateral, proximal)
    return np.stack([x, handed * np.cross(proximal, x), proximal])


def _points(
    condyles: CondyleAxis, plateau: Plateau, femur_shaft: LongAxis, tibia_shaft: LongAxis, femur: TriangleMesh
) -> dict[str, Point]:
    medial_epicondyle, lateral_epicondyle = _epicondyles(femur, condyles)
    found = {
        "medial_condyle_centre": (condyles.medial.centre, condyles.medial.rms),
        "lateral_condyle_centre": (condyles.lateral.centre, condyles.lateral.rms),
        "medial_epicondyle": (medial_epicondyle, 3.0),
        "lateral_epicondyle": (lateral_epicondyle, 3.0),
        "medial_plateau_centre": (plateau.medial, plateau.uncertainty_mm),
        "lateral_plateau_centre": (plateau.lateral, plateau.uncertainty_mm),
        "femur_shaft_centre": (femur_shaft.far_centre, 1.0),
        "tibia_shaft_centre": (tibia_shaft.far_centre, 1.0),
    }
    return {name: Point(position, spread, given=False) for name, (position, spread) in found.items()}


def _epicondyles(femur: TriangleMesh, condyles: CondyleAxis) -> tuple[Float, Float]:
    """Points of the femur farthest along the flexion axis, within 25 mm of it."""
    middle = 0.5 * (condyles.medial.centre + condyles.lateral.centre)
    arm = femur.points - middle
    along = arm @ condyles.direction
    near = np.linalg.norm(arm - along[:, None] * condyles.direction, axis=1) < 25.0
    chosen, along = femur.points[near], along[near]
    return chosen[np.argmin(along)], chosen[np.argmax(along)]


def _chosen_axes(
    points: Mapping[str, Point], condyles: CondyleAxis, plateau_found: Plateau, shafts: tuple[LongAxis, LongAxis]
) -> dict[str, Axis]:
    """Flexion axis, both long axes and the tibia's own lateral, each from given landmarks where there are any."""
    femur_shaft, tibia_shaft = shafts
    medial, lateral = points["medial_condyle_centre"], points["lateral_condyle_centre"]
    knee = 0.5 * (medial.position + lateral.position)
    plateau = 0.5 * (points["medial_plateau_centre"].position + points["lateral_plateau_centre"].position)
    if medial.given or lateral.given:
        flexion = _axis_between(medial.position, lateral.position, "line through the given condyle centres")
    else:
        how = "line through spheres fitted to the posterior condyles"
        flexion = Axis(condyles.direction, condyles.uncertainty_deg, how)
    femoral = _to_given(points, knee, ("femoral_head_centre", "femur_shaft_centre"), femur_shaft.direction)
    tibial = _to_given(points, plateau, ("ankle_centre", "tibia_shaft_centre"), tibia_shaft.direction)
    return {
        "flexion_axis": flexion,
        "femoral_long_axis": femoral or _of_shaft(femur_shaft, 1.0),
        "tibial_long_axis": tibial.reversed() if tibial else _tibial_axis(tibia_shaft, plateau, plateau_found),
        "tibial_mediolateral_axis": _mediolateral(points, plateau_found),
    }


def _mediolateral(points: Mapping[str, Point], found: Plateau) -> Axis:
    medial, lateral = points["medial_plateau_centre"], points["lateral_plateau_centre"]
    if medial.given or lateral.given:
        return _axis_between(medial.position, lateral.position, "line through the given plateau centres")
    direction = unit(found.lateral - found.medial)
    return Axis(direction, found.uncertainty_deg, "line through the centres of the plateau's articular surfaces")


def _to_given(points: Mapping[str, Point], joint: Float, names: tuple[str, ...], shaft: Float) -> Axis | None:
    """Axis to the first of the named landmarks that was given; it has to run roughly along the shaft."""
    for name in names:
        if name in points and points[name].given:
            words = name.replace("_", " ")
            axis = _axis_between(joint, points[name].position, f"from the joint to the given {words}")
            away = angle_deg(axis.direction, shaft)
            if away > GIVEN_AXIS_DEG:
                raise ValueError(f"the given {words} lies {away:.0f} deg off the shaft; is its file LPS or RAS?")
            return axis
    return None


def _axis_between(start: Float, end: Float, how: str) -> Axis:
    length = float(np.linalg.norm(end - start))
    return Axis(unit(end - start), float(np.degrees(np.arctan2(2.0 * GIVEN_MM, length))), how)


def _of_shaft(shaft: LongAxis, sense: float) -> Axis:
    how = f"line through the cross-sections of {shaft.length_mm:.0f} mm of shaft"
    return Axis(sense * shaft.direction, shaft.uncertainty_deg, how)


def _tibial_axis(shaft: LongAxis, plateau: Float, found: Plateau) -> Axis:
    """Sagittal slope from the line of the cross-sections, coronal slope from the plateau's middle to the last section.

    Of a short shaft the line is off by several degrees in the coronal plane, because the metaphysis tapers unevenly;
    the far longer way from the plateau is not (five full legs cut at 60 mm: 1.3 deg on average against 2.3). In the
    sagittal plane it is the other way round (11 deg against 6), because the plateau overhangs the shaft posteriorly.
    """
    proximal = -shaft.direction
    lateral = orthogonal_part(found.lateral - found.medial, proximal)
    way = plateau - shaft.far_centre
    direction = unit(proximal + (way @ lateral) / (way @ proximal) * lateral)
    return replace(_of_shaft(shaft, -1.0), direction=direction)


def _assembled(
    points: dict[str, Point], axes: dict[str, Axis], handed: float, push: Float, signs: tuple[SideSign, ...]
) -> KneeAnatomy:
    at = {name: point.position for name, point in points.items()}
    knee = 0.5 * (at["medial_condyle_centre"] + at["lateral_condyle_centre"])
    plateau = 0.5 * (at["medial_plateau_centre"] + at["lateral_plateau_centre"])
    x = axes["flexion_axis"].direction
    z = orthogonal_part(axes["femoral_long_axis"].direction, x)
    femoral = np.stack([x, handed * np.cross(z, x), z])
    tibial_axis = axes["tibial_long_axis"].direction
    tibial = _rows(tibial_axis, axes["tibial_mediolateral_axis"].direction, handed)
    kinematic = tibial @ smallest_turn(tibial_axis, push).T
    scan_from_femur, scan_from_tibia = rigid(femoral.T, knee), rigid(kinematic.T, plateau)
    return KneeAnatomy(
        points=points,
        axes=axes,
        scan_from_femur=scan_from_femur,
        scan_from_tibia=scan_from_tibia,
        delta=push,
        scan=joint_coordinates(np.linalg.inv(scan_from_femur) @ scan_from_tibia),
        signs=signs,
    )
