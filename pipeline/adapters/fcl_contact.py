"""Exact collision of two triangle bodies with FCL (the descendant of RAPID, by the same group, on the same OBB-tree).

Only the two answers of FCL that can be trusted are used: whether two meshes intersect, and which triangles do. Its
penetration depths, contact positions and contact counts mean nothing for meshes; its inputs are checked here because
it crashes or lies on bad ones.
"""

from __future__ import annotations

import fcl
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.contact import Compartment

Float = NDArray[np.float64]

#: More intersecting pairs than any pose near contact has; FCL needs a bound.
MAX_PAIRS = 100_000
_UNIT = np.eye(3)


class FclBodies:
    """Two rigid bodies; the reference stands still, the moving body is placed by a rotation and a shift.

    Implements :class:`pipeline.kinematics.contact.Bodies`. Both hierarchies are built once; a query only changes the
    transform.

    Parameters
    ----------
    reference, moving : TriangleMesh
        Closed surfaces, mm, each in its kinematic frame.
    eminence_mm : float
        Half width of the strip between the compartments: medial is x < -eminence_mm of the moving body's frame,
        lateral is x > eminence_mm.

    Raises
    ------
    ValueError
        For an empty mesh, non-finite points or indices out of range.
    """

    def __init__(self, reference: TriangleMesh, moving: TriangleMesh, eminence_mm: float = 0.0) -> None:
        self.reference, self.moving = reference, moving
        self._fixed = fcl.CollisionObject(_hierarchy(reference), fcl.Transform())
        self._placed = fcl.CollisionObject(_hierarchy(moving), fcl.Transform())
        self._compartments = _compartments(moving, eminence_mm)
        self._proper: Float | None = None
        self._yes_no = fcl.CollisionRequest(num_max_contacts=1, enable_contact=False)
        self._all = fcl.CollisionRequest(num_max_contacts=MAX_PAIRS, enable_contact=True)

    def intersect(self, rotation: Float, shift: Float) -> bool:
        """Whether any triangle of the placed moving body crosses one of the reference (exact test)."""
        self._place(rotation, shift)
        return bool(fcl.collide(self._fixed, self._placed, self._yes_no, fcl.CollisionResult()))

    def crossing_pairs(self, rotation: Float, shift: Float) -> NDArray[np.int64]:
        """(K, 2) indices of crossing triangles: reference, moving; sorted, without repetition."""
        self._place(rotation, shift)
        result = fcl.CollisionResult()
        fcl.collide(self._fixed, self._placed, self._all, result)
        if not result.contacts:
            return np.empty((0, 2), dtype=np.int64)
        return np.unique(np.array([(c.b1, c.b2) for c in result.contacts], dtype=np.int64), axis=0)

    def compartment_gap(self, compartment: Compartment, rotation: Float, shift: Float) -> float:
        """Smallest distance (mm) of the medial or lateral part from the reference; 0 where they cross, NaN if empty."""
        part = self._compartments[compartment]
        if part is None:
            return float("nan")
        part.setTransform(self._transform(rotation, shift))
        return max(float(fcl.distance(self._fixed, part, fcl.DistanceRequest(), fcl.DistanceResult())), 0.0)

    def _place(self, rotation: Float, shift: Float) -> None:
        self._placed.setTransform(self._transform(rotation, shift))

    def _transform(self, rotation: Float, shift: Float) -> fcl.Transform:
        if rotation is not self._proper:  # one that nobody can write is looked at once
            askew = np.abs(rotation @ rotation.T - _UNIT).max()
            if not (askew < 1e-9 and np.linalg.det(rotation) > 0.0):
                raise ValueError("a placement is a proper rotation (3, 3) and a finite shift (3,)")
            self._proper = None if rotation.flags.writeable else rotation
        if not np.isfinite(shift).all():
            raise ValueError("a placement is a proper rotation (3, 3) and a finite shift (3,)")
        return fcl.Transform(rotation, shift)


def _compartments(moving: TriangleMesh, eminence_mm: float) -> dict[Compartment, fcl.CollisionObject | None]:
    x = moving.points[moving.triangles][:, :, 0].mean(axis=1)
    masks: dict[Compartment, NDArray[np.bool_]] = {"medial": x < -eminence_mm, "lateral": x > eminence_mm}
    return {name: _part(moving, mask) for name, mask in masks.items()}


def _part(mesh: TriangleMesh, mask: NDArray[np.bool_]) -> fcl.CollisionObject | None:
    if not mask.any():
        return None
    return fcl.CollisionObject(_hierarchy(TriangleMesh(mesh.points, mesh.triangles[mask])), fcl.Transform())


def _hierarchy(mesh: TriangleMesh) -> fcl.BVHModel:
    points = np.ascontiguousarray(mesh.points, dtype=np.float64)
    triangles = np.ascontiguousarray(mesh.triangles, dtype=np.int32)
    if len(points) == 0 or len(triangles) == 0:
        raise ValueError("a body needs points and triangles, got an empty mesh")
    if not np.isfinite(points).all():
        raise ValueError("the points of a body are finite numbers")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError("a triangle of a body names a point that is not there")
    model = fcl.BVHModel()
    model.beginModel(len(points), len(triangles))
    model.addSubModel(points, triangles)
    model.endModel()
    return model
