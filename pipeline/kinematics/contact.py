"""Contact of two bodies at one attitude: touching or not, how far along delta, and where they would push.

Everything here is in the attitude frame (x lateral, y anterior, z along delta): the reference is turned into it and
stands still, the moving body turns about z and shifts. The exact triangle test itself comes from outside through
:class:`Bodies`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.containment import nested
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.triangles import near_features, with_neighbours
from pipeline.kinematics.joint_coordinates import Float, attitude_rotation, rotation_z
from pipeline.kinematics.ligaments import NO_FIBRES, NO_LOAD, Fibres, Load, fibre_load

#: A wall whose normal is nearly orthogonal to delta carries no load along it; below this cosine it counts as this
#: steep (about 1 degree), so that its reaction stays finite.
STEEPEST_COSINE = 0.02


Compartment = Literal["medial", "lateral"]


class Pose(NamedTuple):
    """Found coordinates at one attitude: x, y, z in mm (attitude frame) and internal rotation in radians."""

    x: float
    y: float
    z: float
    theta: float

    def displaced(self, motion: tuple[float, float, float]) -> Pose:
        """The pose after (dx, dy, dtheta) in the plane orthogonal to delta."""
        return Pose(self.x + motion[0], self.y + motion[1], self.z, self.theta + motion[2])


class Bodies(Protocol):
    """Two rigid triangle bodies with an exact collision test; each mesh in its kinematic frame, mm."""

    reference: TriangleMesh
    moving: TriangleMesh

    def intersect(self, rotation: Float, shift: Float) -> bool:
        """Whether surfaces cross with the moving body at ``rotation @ p + shift`` in the reference frame."""
        ...

    def crossing_pairs(self, rotation: Float, shift: Float) -> NDArray[np.int64]:
        """(K, 2) indices of crossing triangles: reference, moving."""
        ...

    def compartment_gap(self, compartment: Compartment, rotation: Float, shift: Float) -> float:
        """Smallest distance (mm) of one compartment of the moving body from the reference; 0 where they cross."""
        ...


@dataclass(frozen=True, eq=False)
class Contacts:
    """Feature pairs closer than the contact band, in the attitude frame.

    Attributes
    ----------
    points : (K, 3) float64
        On the reference, mm.
    normals : (K, 3) float64
        Unit, from the reference to the moving body: the direction of the reaction.
    gaps : (K,) float64
        Distance of the features, mm.
    """

    points: Float
    normals: Float
    gaps: Float

    def __len__(self) -> int:
        return len(self.gaps)

    def within(self, band_mm: float) -> Contacts:
        """Those that are closer than a band."""
        near = self.gaps <= band_mm
        return Contacts(self.points[near], self.normals[near], self.gaps[near])


class AttitudeContact:
    """The two bodies at one held attitude.

    Parameters
    ----------
    bodies : Bodies
    flexion_rad, varus_rad : float
    fibres : Fibres
        Attachments on the reference in its own frame.
    """

    def __init__(self, bodies: Bodies, flexion_rad: float, varus_rad: float, fibres: Fibres = NO_FIBRES) -> None:
        self.bodies = bodies
        self._reference_from_attitude = attitude_rotation(flexion_rad, varus_rad)
        self._turned = 0.0, self._reference_from_attitude
        self._fibres = fibres._replace(on_reference=fibres.on_reference @ self._reference_from_attitude)

    def load(self, pose: Pose) -> Load:
        """What the fibres do at ``pose``."""
        return fibre_load(self._fibres, (pose.x, pose.y, pose.theta, pose.z))

    def merit(self, pose: Pose) -> float:
        """What a stable pose is a local maximum of: depth along delta, less the energy of the fibres, mm."""
        return pose.z - self.load(pose).energy_mm

    def touches(self, pose: Pose) -> bool:
        """Whether the surfaces cross at ``pose``."""
        return self.bodies.intersect(*self._placement(pose))

    def gap(self, compartment: Compartment, pose: Pose) -> float:
        """Smallest distance of one compartment at ``pose``, mm; NaN where the body has no such compartment."""
        return self.bodies.compartment_gap(compartment, *self._placement(pose))

    def nested(self, pose: Pose) -> bool:
        """Whether one body lies inside the other at ``pose``, where surfaces may not cross at all."""
        return nested(self.bodies.reference, self.bodies.moving, *self._placement(pose))

    def contacts(self, pose: Pose, band_mm: float, *, along_only: bool = False) -> Contacts:
        """Feature pairs within ``band_mm`` at a pose where the bodies are clear of one another.

        Parameters
        ----------
        pose : Pose
        band_mm : float
        along_only : bool
            Leave out walls that a push along delta does not reach: quicker, and enough to choose a motion, which is
            tested against walls on its way.

        Notes
        -----
        Candidates are the triangles that cross when the moving body is pushed by about the band. The reaction of a
        feature pair acts along the line between its points: the face normal for vertex on face, the cross product for
        edge on edge; it stays right at ridges and rims where face normals do not.
        """
        pairs = self._candidates(_pushes(pose, band_mm, along_only=along_only))
        rotation, shift = self._placement(pose)
        reference, moving = self.bodies.reference, self.bodies.moving
        first = reference.points[_patches(reference)[pairs[:, 0]]]
        second = moving.points[_patches(moving)[pairs[:, 1]]] @ rotation.T + shift
        near = near_features(first, second, band_mm)
        normals = (near.on_second - near.on_first) / near.distance[:, None]
        keep = _distinct(near.on_first, normals, near.distance)
        to_attitude = self._reference_from_attitude
        return Contacts(near.on_first[keep] @ to_attitude, normals[keep] @ to_attitude, near.distance[keep])

    def _candidates(self, pushes: list[Pose]) -> NDArray[np.int64]:
        found = [self.bodies.crossing_pairs(*self._placement(pushed)) for pushed in pushes]
        return np.unique(np.concatenate(found), axis=0)

    def _placement(self, pose: Pose) -> tuple[Float, Float]:
        if self._turned[0] != pose.theta:  # most tests follow one another along delta
            rotation = self._reference_from_attitude @ rotation_z(pose.theta)
            rotation.flags.writeable = False
            self._turned = pose.theta, rotation
        return self._turned[1], self._reference_from_attitude @ np.array([pose.x, pose.y, pose.z])


@lru_cache(maxsize=8)
def _patches(mesh: TriangleMesh) -> NDArray[np.int32]:
    """(M, 6) each triangle with its neighbours; the same for every attitude, so worked out once for a mesh."""
    return with_neighbours(mesh.triangles)


def _pushes(pose: Pose, band_mm: float, *, along_only: bool) -> list[Pose]:
    """The pose pushed by the band: along delta (twice as far: slopes to 60 deg) and against walls all round.

    Triangles that lie wholly inside the other body cross nothing, so on finely faceted surfaces a deep push finds only
    a ring about the contact; the short pushes find what is nearer, down to the contact itself.
    """
    along = [pose._replace(z=pose.z + part * band_mm) for part in (2.0, 0.25, 0.03, 0.004)]
    if along_only:
        return along
    turns = np.arange(4) * (np.pi / 2)
    tilted = [
        Pose(pose.x + 1.5 * band_mm * np.cos(a), pose.y + 1.5 * band_mm * np.sin(a), pose.z + 0.5 * band_mm, pose.theta)
        for a in turns
    ]
    return along + tilted


def _distinct(points: Float, normals: Float, gaps: Float) -> NDArray[np.int64]:
    """Indices of contacts without repetition: neighbouring triangles report the same vertex or edge many times.

    One vertex may rest on two faces, so normals tell contacts apart as well.
    """
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    rounded = np.round(np.column_stack([points, gaps, 0.1 * normals]), 4)
    return np.unique(rounded, axis=0, return_index=True)[1]


def reaction_rates(contacts: Contacts, pose: Pose, load: Load = NO_LOAD) -> Float:
    """(K, 3) how much each contact lets the merit grow, per mm of x, mm of y and rad of theta.

    A motion u of the contact point keeps clear while normal . u >= 0; with u = (dx, dy, dz) + dtheta z x (r - d) that
    is dz <= rates . (dx, dy, dtheta). Without fibres the merit is the depth; with them each mm of depth is worth what
    they leave of the push or add to it, and the motion itself costs their slope. The least rate over all contacts is
    what the motion gains.
    """
    n = contacts.normals
    lever = contacts.points[:, :2] - [pose.x, pose.y]
    torque = lever[:, 0] * n[:, 1] - lever[:, 1] * n[:, 0]
    return load.push * np.column_stack([n[:, 0], n[:, 1], torque]) / support(contacts)[:, None] - load.slope[:3]


def reaction_slack(contacts: Contacts, load: Load = NO_LOAD) -> Float:
    """(K,) how much the merit grows along delta before each contact closes, mm."""
    return load.push * contacts.gaps / support(contacts)


def support(contacts: Contacts) -> Float:
    """(K,) share of each reaction that holds the body against delta."""
    return np.maximum(-contacts.normals[:, 2], STEEPEST_COSINE)
