"""The direct solver: the stable pose at one attitude in a few steps, and exact depths and contacts there.

A stable pose is a local maximum of the depth h(x, y, theta) that the moving body reaches along delta. h is the least of
many smooth functions, so each step is a small linear programme within a trust region: first over samples of the moving
body under a height map of the reference, which is quick and sees past single facets, then over the exact features of
both meshes, so that the pose is a maximum of the triangles themselves and its z is exact contact.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pipeline.kinematics.cell import Certificate, ProofSettings, certificate
from pipeline.kinematics.contact import Contacts, Pose
from pipeline.kinematics.direct.enclosure import enclosed
from pipeline.kinematics.direct.kernels import Climber, Kernels
from pipeline.kinematics.direct.margin import margins
from pipeline.kinematics.direct.polish import depth_at, polish, rows_below
from pipeline.kinematics.direct.prepare import DirectBodies
from pipeline.kinematics.direct.search import search
from pipeline.kinematics.direct.settings import DirectSettings, SearchLimits
from pipeline.kinematics.direct.surfaces import FAR_MM, Attitude, Float
from pipeline.kinematics.incremental import StablePose
from pipeline.kinematics.joint_coordinates import attitude_rotation, rotation_z
from pipeline.kinematics.ligaments import NO_FIBRES, Fibres, fibre_load
from pipeline.kinematics.solvers import Margin
from pipeline.kinematics.table import Status

#: Steps of the stability margin: 1 mm, 1 mm, 2 deg.
MARGIN_STEP = np.array([1.0, 1.0, np.radians(2.0)])


COMPILED = Kernels(search, polish, depth_at)

#: A pose is left this much short of exact contact, so that it is clear beyond rounding (mm).
CLEAR_MM = 1e-4
#: Where a start lay so much too deep, one body may have held the other (mm).
PULLED_MM = 1.0
#: Depths nearer than this are the same (mm).
ROUNDING_MM = 1e-7
#: Contacts on slopes up to 60 degrees are looked for: twice their distance along delta.
BAND_ALONG = 2.0


@dataclass(frozen=True, eq=False)
class DirectSolver:
    """The direct solver for one pair of bodies.

    Attributes
    ----------
    bodies : DirectBodies
    settings : DirectSettings
    proof : ProofSettings
        What counts as a contact of the certificate.
    fibres : Fibres
        Attachments on the reference in its own frame.
    kernels : Kernels
    """

    bodies: DirectBodies
    settings: DirectSettings = field(default_factory=DirectSettings)
    proof: ProofSettings = field(default_factory=ProofSettings)
    fibres: Fibres = NO_FIBRES
    kernels: Kernels = COMPILED

    def at(self, angles_rad: tuple[float, float]) -> DirectAttitude:
        """The bodies at flexion and varus."""
        return DirectAttitude(self, angles_rad)


class DirectAttitude:
    """Two prepared bodies at one held attitude.

    Parameters
    ----------
    solver : DirectSolver
    angles_rad : (flexion, varus)
    """

    def __init__(self, solver: DirectSolver, angles_rad: tuple[float, float]) -> None:
        self.solver = solver
        self._angles_rad = angles_rad
        self._bare: Attitude | None = None
        self._mapped: tuple[Attitude, Pose] | None = None

    def solve(self, start: Pose, centre: Pose | None = None) -> StablePose:
        """The stable pose reached from ``start``.

        Parameters
        ----------
        start : Pose
            Where the moving body is let go.
        centre : Pose, optional
            Middle of the bounds; the start when not given.

        Returns
        -------
        StablePose
            ``NO_CONTACT`` when nothing is met, ``SLID_OFF`` and ``ROTATION_BOUND`` when the body leaves the bounds,
            ``NOT_CONVERGED`` when the steps run out.
        """
        found, steps, ended = self._climb(start)
        if (found is None or found.z < start.z - PULLED_MM) and self._enclosed(start):
            return StablePose(start, Status.NO_CONTACT, steps, 0)
        if found is None:
            return StablePose(start, Status.SLID_OFF if steps else Status.NO_CONTACT, steps, 0)
        status = _out_of_bounds(found, centre or start._replace(z=found.z), self.solver.settings)
        return StablePose(found, status or (Status.OK if ended else Status.NOT_CONVERGED), steps, 0)

    def depth(self, pose: Pose) -> Pose | None:
        """The pose brought to contact along delta (just clear of it); None where nothing is met."""
        z = self._depth(pose)
        return None if z > FAR_MM else pose._replace(z=z - CLEAR_MM)

    def contacts(self, pose: Pose, band_mm: float) -> Contacts:
        """Features within ``band_mm`` that meet along delta, at a pose just clear of contact; attitude frame."""
        attitude, place = self._surfaces_at(pose), _array(pose)
        rows = rows_below(attitude, place, pose.z + BAND_ALONG * band_mm)
        slopes = rows.rates[:, :2]
        cosine = 1.0 / np.sqrt(1.0 + np.einsum("ij,ij->i", slopes, slopes))
        gaps = (rows.gaps - pose.z) * cosine
        near = gaps <= band_mm
        normals = np.column_stack([slopes, np.full(len(slopes), -1.0)]) * cosine[:, None]
        points = np.column_stack([rows.arms + place[:2], rows.gaps])
        return Contacts(points[near], normals[near], gaps[near])

    def certify(self, pose: Pose) -> Certificate:
        """The certificate of a pose just clear of contact."""
        proof = self.solver.proof
        load = fibre_load(self._surfaces_at(pose).fibres, (pose.x, pose.y, pose.theta, pose.z))
        return certificate(self.contacts(pose, proof.contact_band_mm), pose, proof.eminence_mm, load)

    def margin(self, pose: Pose) -> Margin:
        """How far the body may be pushed at a stable pose, on the height map."""
        out = np.empty(3)
        margins(self._map_about(pose), _array(pose), MARGIN_STEP, out)
        return Margin(float(out[0]), float(out[1]), float(np.degrees(out[2])))

    def _climb(self, start: Pose) -> Climb:
        """Over the height map, then over the triangles; a second time over all of them where some were overlooked."""
        kernels, settings = self.solver.kernels, self.solver.settings
        best = self._run(kernels.search, start, settings.search)
        if best.pose is None and best.steps == 0 and (met := self.depth(start)) is not None:
            best = Climb(met, 0, ended=True)  # thinner than the nodes of the map lie apart
        if best.pose is None:
            return best
        found = self._run(kernels.polish, best.pose, settings.polish)
        if found.pose is None or self._depth(found.pose) < found.pose.z - ROUNDING_MM:
            found = self._run(kernels.polish, found.pose or best.pose, settings.polish._replace(slack_mm=np.inf))
        clear = found.pose and found.pose._replace(z=found.pose.z - CLEAR_MM)
        return Climb(clear, best.steps + found.steps, best.ended and found.ended)

    def _run(self, kernel: Climber, start: Pose, limits: SearchLimits) -> Climb:
        attitude, found = self._map_about(start), np.empty(4)
        steps = kernel(attitude, _array(start), limits, found)
        if found[3] + self._highest > attitude.ceiling_mm:
            # what was left out may be met first
            self._mapped = self.solver.bodies.at(self._angles_rad, start._replace(z=np.inf), self.solver.fibres), start
            return self._run(kernel, start, limits)
        return Climb(None if found[3] > FAR_MM else _pose(found), steps, steps < limits.steps)

    def _depth(self, pose: Pose) -> float:
        """Exact depth at a pose, more than ``FAR_MM`` where nothing is met."""
        depth_at, near = self.solver.kernels.depth_at, self._surfaces_at(pose)
        z = depth_at(near, _array(pose))
        if z + self._highest > near.ceiling_mm:  # what was left out may be met first
            z = depth_at(self._surfaces_at(pose._replace(z=np.inf)), _array(pose))
        return z

    def _enclosed(self, pose: Pose) -> bool:
        bodies, to_reference = self.solver.bodies, attitude_rotation(*self._angles_rad)
        shift = to_reference @ np.array([pose.x, pose.y, pose.z])
        return enclosed(*bodies.hulls, to_reference @ rotation_z(pose.theta), shift)

    def _map_about(self, pose: Pose) -> Attitude:
        window_mm = self.solver.bodies.settings.window_mm
        if self._mapped is None or np.hypot(*np.subtract(pose, self._mapped[1])[:2]) > window_mm:
            self._mapped = self.solver.bodies.at(self._angles_rad, pose, self.solver.fibres), pose
        return self._mapped[0]

    def _surfaces_at(self, pose: Pose) -> Attitude:
        """Both surfaces, complete about the height of a pose."""
        needed = pose.z + self._highest + 1.0
        if self._mapped is not None and needed < self._mapped[0].ceiling_mm:
            return self._mapped[0]
        if self._bare is None or needed >= self._bare.ceiling_mm:
            ceiling = needed + self.solver.bodies.settings.headroom_mm
            self._bare = self.solver.bodies.turned(self._angles_rad, ceiling, self.solver.fibres)
        return self._bare

    @property
    def _highest(self) -> float:
        return self.solver.bodies.bins.highest


class Climb(NamedTuple):
    """What a climb came to: the pose, None where the body is lost; its steps; whether it ended before they ran out."""

    pose: Pose | None
    steps: int
    ended: bool


def _array(pose: Pose) -> Float:
    """x, y, theta, z: the order of the kernels."""
    return np.array([pose.x, pose.y, pose.theta, pose.z], dtype=np.float64)


def _pose(found: Float) -> Pose:
    x, y, theta, z = (float(value) for value in found)
    return Pose(x, y, z, theta)


def _out_of_bounds(pose: Pose, centre: Pose, settings: DirectSettings) -> Status | None:
    away = np.subtract(pose, centre)
    if np.hypot(away[0], away[1]) > settings.slide_bound_mm or away[2] > settings.slide_bound_mm:
        return Status.SLID_OFF
    return Status.ROTATION_BOUND if abs(away[3]) > settings.rotation_bound_rad else None
