"""The paper's two test objects, whose stable pose is known in closed form: a ball in a dish, a bar on two pyramids.

Scan space here has z up, and delta points down: bodies fall. The kinematic frames of both bodies therefore have
x = scan x, y = -scan y and z = -scan z = delta, so that a height above the reference's origin is a negative proximal
shift, and a turn that is counter-clockwise from above is a negative rotation about delta.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh

Float = NDArray[np.float64]

#: Turns z up into z along delta, which points down: half a turn about x.
_DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class RestPose:
    """Where the moving body comes to rest: its kinematic frame in the reference's; None where any value is stable."""

    lateral_mm: float
    anterior_mm: float | None
    proximal_mm: float
    internal_rotation_deg: float | None


@dataclass(frozen=True, eq=False)
class ValidationPair:
    """Two bodies, where they are let go, and where they must come to rest.

    Attributes
    ----------
    reference, moving : mapping of str to TriangleMesh
        Structure name -> closed surface in scan space, mm, where it is let go.
    scan_from_reference, scan_from_moving : (4, 4) float64
        Kinematic frames; z is delta.
    rest : RestPose
    """

    reference: Mapping[str, TriangleMesh]
    moving: Mapping[str, TriangleMesh]
    scan_from_reference: Float
    scan_from_moving: Float
    rest: RestPose

    @property
    def reference_body(self) -> TriangleMesh:
        """All reference structures as one mesh, in the reference's kinematic frame."""
        return _in_frame(_joined(tuple(self.reference.values())), self.scan_from_reference)

    @property
    def moving_body(self) -> TriangleMesh:
        """All moving structures as one mesh, in the moving body's kinematic frame."""
        return _in_frame(_joined(tuple(self.moving.values())), self.scan_from_moving)


@dataclass(frozen=True)
class BallInDish:
    """A ball above a dish, a solid with a spherical hollow that is open upwards.

    Both are solids of revolution with a vertex on the axis and latitude rings whose spacing grows away from it. At an
    offset d from the dish's axis (R the dish's radius, r the ball's, theta = d / (R - r), S sectors, a and b the
    first spacings of dish and ball in radians) faceting changes the height of contact by less than

        (R a^2 + r b^2) / 8  +  (R + r) theta^2 (pi / S)^2 / 2

    which is 1.2e-4 mm on the axis and 1.6e-4 mm at 0.1 mm from it. As b > a, the ball's lowest vertex alone touches
    when centred, so the height there is exact: the ball's centre rests r above the lowest point of the hollow.

    Attributes
    ----------
    dish_radius_mm, ball_radius_mm : float
        The ball's is the smaller.
    let_go_mm : 3 floats
        Scan coordinates of the ball's centre at the start; the hollow's lowest point is the origin.
    """

    dish_radius_mm: float = 12.0
    ball_radius_mm: float = 6.0
    let_go_mm: tuple[float, float, float] = (2.5, -1.5, 10.0)

    def pair(self) -> ValidationPair:
        """The two bodies with their answer."""
        return ValidationPair(
            reference={"dish": dish(self.dish_radius_mm)},
            moving={"ball": _shifted(ball(self.ball_radius_mm), np.asarray(self.let_go_mm))},
            scan_from_reference=_frame(np.eye(3), (0.0, 0.0, 0.0)),
            scan_from_moving=_frame(np.eye(3), self.let_go_mm),
            rest=RestPose(0.0, 0.0, -self.ball_radius_mm, None),
        )


@dataclass(frozen=True)
class BarOnPyramids:
    """A rectangular bar above two triangular pyramids whose inner faces face one another and lean outwards.

    The inner faces are triangles with base corners (+-g, -b, 0), (+-g, b, 0) and apex (+-(g + c H), 0, H). With g the
    half gap, b the half base, c the lean, H the height and w the half width of the bar, g < w < g + c H:

    The bar's lower long edges at height s meet the pyramids' section there, whose inner edge lies at g + c s and
    reaches to +-b (1 - s/H) along y. With the bar turned by psi and its axis displaced sideways by u, the ends of
    those inner edges touch first, and the bar stands at

        s(u, psi) = (w + |u| - g cos(psi) + b |sin(psi)|) / (c cos(psi) + (b/H) |sin(psi)|)

    which is least, s0 = (w - g) / c, only at u = psi = 0: it comes to rest unturned, in the middle. For bars whose
    half length is at least b (1 - s0/H) + |y| nothing depends on the displacement y along the bar.

    Attributes
    ----------
    half_gap_mm, half_base_mm, lean, height_mm : float
        g, b, c, H of the pyramids.
    half_width_mm, half_length_mm, thickness_mm : float
        w of the bar, half its length along y, its size upwards.
    let_go_mm : 3 floats
        Scan coordinates of the middle of the bar's lower face at the start.
    turn : 2 floats
        Cosine and sine of its turn about delta at the start; from a Pythagorean triple, so that files hold it exactly.
    """

    half_gap_mm: float = 6.0
    half_base_mm: float = 12.0
    lean: float = 0.8
    height_mm: float = 16.0
    half_width_mm: float = 10.0
    half_length_mm: float = 30.0
    thickness_mm: float = 8.0
    let_go_mm: tuple[float, float, float] = (1.5, 2.0, 20.0)
    turn: tuple[float, float] = (0.96, 0.28)

    @property
    def rest_height_mm(self) -> float:
        """s0: how far above the base the bar's lower face comes to rest."""
        return (self.half_width_mm - self.half_gap_mm) / self.lean

    @property
    def neutral_range_mm(self) -> float:
        """Largest displacement along the bar that changes nothing."""
        return self.half_length_mm - self.half_base_mm * (1.0 - self.rest_height_mm / self.height_mm)

    def standing_height_mm(self, sideways_mm: float, turn_rad: float) -> float:
        """s(u, psi): height of the lower face at first contact, where the contacts lie within the bar's length."""
        cosine, sine = np.cos(turn_rad), abs(np.sin(turn_rad))
        reach = self.half_width_mm + abs(sideways_mm) - self.half_gap_mm * cosine + self.half_base_mm * sine
        return float(reach / (self.lean * cosine + self.half_base_mm / self.height_mm * sine))

    def pair(self) -> ValidationPair:
        """The two bodies with their answer."""
        cosine, sine = self.turn
        turned = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        width, length = self.half_width_mm, self.half_length_mm
        upright = box((-width, width), (-length, length), (0.0, self.thickness_mm))
        bar = TriangleMesh(upright.points @ turned.T + self.let_go_mm, upright.triangles)
        return ValidationPair(
            reference={"left_pyramid": self._pyramid(-1.0), "right_pyramid": self._pyramid(1.0)},
            moving={"bar": bar},
            scan_from_reference=_frame(np.eye(3), (0.0, 0.0, 0.0)),
            scan_from_moving=_frame(turned, self.let_go_mm),
            rest=RestPose(0.0, None, -self.rest_height_mm, 0.0),
        )

    def _pyramid(self, sign: float) -> TriangleMesh:
        """The pyramid at x > 0 (sign +1) or its mirror image (-1); the fourth corner is farther out, on the base."""
        top = self.half_gap_mm + self.lean * self.height_mm
        corners = [(self.half_gap_mm, -self.half_base_mm, 0.0), (self.half_gap_mm, self.half_base_mm, 0.0)]
        corners += [(top, 0.0, self.height_mm), (top + self.half_base_mm, 0.0, 0.0)]
        triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)
        return TriangleMesh(np.array(corners) * [sign, 1.0, 1.0], triangles if sign > 0 else triangles[:, ::-1])


def ball(radius_mm: float, sectors: int = 24) -> TriangleMesh:
    """A closed sphere about the origin, finely faceted near its lowest point; axis z, up."""
    angles = _graded_angles(np.pi, 0.010)
    profile = radius_mm * np.column_stack([np.sin(angles), -np.cos(angles)])
    return revolved(np.vstack([[0.0, -radius_mm], profile[:-1], [0.0, radius_mm]]), sectors)


def dish(radius_mm: float, opening_rad: float = 0.9, sectors: int = 24) -> TriangleMesh:
    """A closed solid with a spherical hollow, open upwards, whose lowest point is the origin; finely faceted there.

    Parameters
    ----------
    radius_mm : float
        Of the hollow.
    opening_rad : float
        Angle from the axis at which the hollow ends in a flat rim.
    sectors : int
        Corners of each latitude ring.
    """
    angles = _graded_angles(opening_rad, 0.005)
    hollow = radius_mm * np.column_stack([np.sin(angles), 1.0 - np.cos(angles)])
    wall = 0.25 * radius_mm
    outside = np.array([[hollow[-1, 0] + wall, hollow[-1, 1]], [hollow[-1, 0] + wall, -wall], [0.0, -wall]])
    return revolved(np.vstack([[0.0, 0.0], hollow, outside])[::-1], sectors)


def box(x_mm: tuple[float, float], y_mm: tuple[float, float], z_mm: tuple[float, float]) -> TriangleMesh:
    """A closed box between two values of each coordinate: 12 triangles, outward normals."""
    points = np.array([(x, y, z) for x in x_mm for y in y_mm for z in z_mm])
    faces = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = [corner for a, b, c, d in faces for corner in ((a, b, c), (a, c, d))]
    return TriangleMesh(points, np.array(triangles, dtype=np.int32))


def revolved(profile: Float, sectors: int) -> TriangleMesh:
    """The closed surface that a profile sweeps about z.

    Parameters
    ----------
    profile : (P, 2) float64
        Radius and z, mm, from the axis to the axis; the solid lies to the left of its way (radius to the right, z up).
    sectors : int
        At least 3.
    """
    around = 2.0 * np.pi * np.arange(sectors) / sectors
    circle = np.column_stack([np.cos(around), np.sin(around)])
    rings = [np.column_stack([r * circle, np.full(sectors, z)]) for r, z in profile[1:-1]]
    poles = [[0.0, 0.0, profile[0, 1]], [0.0, 0.0, profile[-1, 1]]]
    return TriangleMesh(np.vstack([*rings, poles]), _ring_triangles(len(rings), sectors))


def _ring_triangles(rings: int, sectors: int) -> NDArray[np.int32]:
    """Triangles of stacked rings (each counter-clockwise from above), closed by a first and a last pole."""
    first, last = rings * sectors, rings * sectors + 1
    here = np.arange(sectors)
    beside = np.roll(here, -1)
    strips = []
    for below in range(0, first - sectors, sectors):
        above = below + sectors
        strips += [(here + below, beside + below, beside + above), (here + below, beside + above, here + above)]
    top = first - sectors
    caps = [(beside, here, np.full(sectors, first)), (here + top, beside + top, np.full(sectors, last))]
    return np.vstack([np.column_stack(corners) for corners in (*strips, *caps)]).astype(np.int32)


def _graded_angles(end_rad: float, first_rad: float) -> Float:
    """(N,) polar angles of the rings up to the end: the spacing grows by an eighth from ring to ring, to 0.1 rad."""
    spacing = np.minimum(first_rad * 1.125 ** np.arange(200.0), 0.1)
    angles = np.cumsum(spacing)
    return np.append(angles[angles < end_rad - 0.5 * 0.1], end_rad)


def _joined(meshes: tuple[TriangleMesh, ...]) -> TriangleMesh:
    starts = np.cumsum([0, *(len(mesh.points) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)]
    return TriangleMesh(np.vstack([mesh.points for mesh in meshes]), np.vstack(triangles).astype(np.int32))


def _in_frame(mesh: TriangleMesh, scan_from_frame: Float) -> TriangleMesh:
    """A mesh of scan space in a right-handed frame."""
    return TriangleMesh((mesh.points - scan_from_frame[:3, 3]) @ scan_from_frame[:3, :3], mesh.triangles)


def _shifted(mesh: TriangleMesh, shift: Float) -> TriangleMesh:
    return TriangleMesh(mesh.points + shift, mesh.triangles)


def _frame(turned: Float, origin_mm: tuple[float, float, float]) -> Float:
    """(4, 4) kinematic frame whose z is delta (down), turned about it."""
    frame = np.eye(4)
    frame[:3, :3] = turned @ _DOWN
    frame[:3, 3] = origin_mm
    return frame
