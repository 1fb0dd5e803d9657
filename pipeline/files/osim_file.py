r"""``joint.osim``: the table as a CustomJoint of OpenSim 4, a function of flexion and varus alone.

The table says (:mod:`pipeline.kinematics.joint_coordinates`; frames x lateral, y anterior, z proximal)

    p_reference = R p_moving + t,    R = Rx(-flexion) Ry(varus) Rz(rotation),    t = Rx(-flexion) Ry(varus) d

and a CustomJoint says: three rotations about given axes, each in the frame that the one before left, and a translation
along given axes of the *parent's* frame. So the rotations are taken as they are, in our order, and the translations are
those of t, not of d: d is measured in the attitude frame, which the parent does not know.

OpenSim's bodies have X anterior, Y proximal, Z to the right, so p_body = P p with s = +1 for a right joint (lateral is
right) and s = -1 for a left one (whose frames x lateral, y anterior, z proximal are left-handed):

    P = [[0, 1, 0], [0, 0, 1], [s, 0, 0]],    det P = s

A rotation by a about the axis e becomes P Re(a) P^-1, the rotation by det(P) a about P e. Hence

    Rx(-flexion):  P x = s Z,  by -s flexion    = by  flexion   about  -Z        (s s = 1)
    Ry(varus):     P y = X,    by  s varus      = by  varus     about s X
    Rz(rotation):  P z = Y,    by  s rotation   = by  rotation  about s Y
    t:             X = t_anterior,  Y = t_proximal,  Z = s t_lateral

so one rule serves both sides, coordinates keep their clinical signs, and the joint is the table's exactly, but for the
functions: the rotation is the table's own polynomial, re-expanded from Chebyshev terms into powers of radians; t is
no polynomial (contact makes the depth, sines and cosines the rest) and is fitted by least squares at the entries.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isqrt

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev
from numpy.polynomial.polynomial import polyval2d
from numpy.typing import NDArray

from pipeline.files.lut_content import LutFileContent
from pipeline.files.meshes import encode_stl
from pipeline.geometry.mesh import TriangleMesh, transformed
from pipeline.kinematics.interpolation import found_coordinates, placement, usable_entries
from pipeline.kinematics.smoothing import ends, scaled
from pipeline.kinematics.table import Grid

Float = NDArray[np.float64]
Color = tuple[int, int, int]

#: Total degree of the fitted functions, that of the table's own.
DEGREE = 6
GEOMETRY_FOLDER = "Geometry"

_MM_PER_M = 1000.0
_STL_HEADER = b"binary STL, metres, frame of an OpenSim body: X anterior, Y proximal, Z right".ljust(80)
_ROTATION = "internal_rotation_deg"


@dataclass(frozen=True, eq=False)
class JointFunction:
    """A function of (flexion, varus) in radians.

    Attributes
    ----------
    name : str
        ``internal_rotation``, ``lateral``, ``anterior`` or ``proximal``; the last three in the reference frame.
    powers : (N + 1, N + 1) float64
        Factor of flexion^i varus^j; 0 where i + j > N. Radians or metres.
    deviation_max, deviation_rms : float
        From the usable entries of the table; degrees or millimetres.
    """

    name: str
    powers: Float
    deviation_max: float
    deviation_rms: float

    @property
    def unit(self) -> str:
        """Unit of the deviations."""
        return "deg" if self.name == "internal_rotation" else "mm"


@dataclass(frozen=True)
class OsimBody:
    """A body: its name and the structures drawn with it, each with its colour (sRGB 0..255)."""

    name: str
    structures: tuple[tuple[str, Color], ...]


def joint_functions(content: LutFileContent) -> tuple[JointFunction, ...]:
    """Rotation, then lateral, anterior and proximal translation of the CustomJoint.

    Raises
    ------
    ValueError
        For a table without a usable entry.
    """
    smooth, usable = content.smooth, usable_entries(content.smooth.poses)
    if not usable.any():
        raise ValueError("a table without a usable entry has no functions")
    rotation, shift = _in_reference(content)
    own = {fit.name: fit.coefficients for fit in smooth.fits}.get(_ROTATION)
    turn = _fitted(smooth.grid, usable, rotation) if own is None else own
    found = [_function("internal_rotation", turn, smooth.grid, rotation)]
    for axis, name in enumerate(("lateral", "anterior", "proximal")):
        terms = _fitted(smooth.grid, usable, shift[..., axis])
        found.append(_function(name, terms, smooth.grid, shift[..., axis]))
    return tuple(found)


def body_from_scan(content: LutFileContent, body: str) -> Float:
    """(4, 4) map of scan space (LPS mm) to the frame of ``reference`` or ``moving`` as OpenSim's body (metres)."""
    scan_from_frame = content.scan_from_reference if body == "reference" else content.scan_from_moving
    to_body = np.eye(4)
    to_body[:3, :3] = _axes(content.side) / _MM_PER_M
    return np.asarray(to_body @ np.linalg.inv(scan_from_frame), dtype=np.float64)


def encode_body_stl(mesh: TriangleMesh, content: LutFileContent, body: str) -> bytes:
    """Binary STL of a scanned structure (LPS mm) in the frame of its body, metres; outward normals."""
    data = encode_stl(transformed(mesh, body_from_scan(content, body)))
    return _STL_HEADER + data[len(_STL_HEADER) :]


def encode_osim(content: LutFileContent, reference: OsimBody, moving: OsimBody) -> bytes:
    """``joint.osim`` for OpenSim 4.2 or newer; geometry is looked for in :data:`GEOMETRY_FOLDER` beside it.

    Raises
    ------
    ValueError
        For a table without a usable entry.
    """
    functions = joint_functions(content)
    root = ET.Element("OpenSimDocument", Version="40000")
    root.append(ET.Comment(_remarks(content, functions)))
    model = _child(root, "Model", name=f"{content.joint}_{content.side[0]}")
    bodies = _objects(model, "BodySet", "bodyset")
    for body in (reference, moving):
        _add_body(bodies, body)
    joints = _objects(model, "JointSet", "jointset")
    _add_joint(joints, "WeldJoint", f"ground_{reference.name}", ("/ground", f"/bodyset/{reference.name}"))
    frames = (f"/bodyset/{reference.name}", f"/bodyset/{moving.name}")
    _fill_joint(_add_joint(joints, "CustomJoint", f"{content.joint}_{content.side[0]}", frames), content, functions)
    ET.indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root) + b"\n"


def _axes(side: str) -> Float:
    """P of the module's text."""
    return np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [_sign(side), 0.0, 0.0]])


def _sign(side: str) -> float:
    return 1.0 if side == "right" else -1.0


def _in_reference(content: LutFileContent) -> tuple[Float, Float]:
    """(F, V) rotation in degrees and (F, V, 3) t in mm of every entry; NaN where not usable."""
    grid, found = content.smooth.grid, found_coordinates(content.smooth.poses)
    flexion, varus = np.meshgrid(np.radians(grid.flexion_deg), np.radians(grid.varus_deg), indexing="ij")
    angles = np.stack([flexion, varus, np.radians(found[..., 3])])
    c, s = np.cos(angles), np.sin(angles)
    rows = placement((c[0], c[1], c[2]), (s[0], s[1], s[2]), (found[..., 0], found[..., 1], found[..., 2]))
    return found[..., 3], np.stack([rows[3], rows[7], rows[11]], axis=-1)


def _fitted(grid: Grid, usable: NDArray[np.bool_], values: Float) -> Float:
    """(P + 1, Q + 1) Chebyshev coefficients of total degree up to :data:`DEGREE`, by least squares."""
    p, q = (_degree(count) for count in grid.shape)
    kept = np.add.outer(np.arange(p + 1), np.arange(q + 1)) <= DEGREE
    terms = chebyshev.chebvander2d(*_scaled(grid), [p, q]).reshape(*grid.shape, p + 1, q + 1)[usable][:, kept]
    out = np.zeros(kept.shape)
    out[kept] = np.linalg.lstsq(terms, values[usable], rcond=None)[0]
    return out


def _degree(count: int) -> int:
    """Highest degree that stays calm between this many even samples: below 2 sqrt(count) (Dahlquist & Bjorck 2008)."""
    return min(DEGREE, count - 1, isqrt(4 * count))


def _scaled(grid: Grid) -> tuple[Float, Float]:
    """Flexion and varus of every entry, each with the ends of its range taken to -1 and 1."""
    axes = (scaled(axis, ends(axis)) for axis in (grid.flexion_deg, grid.varus_deg))
    flexion, varus = np.meshgrid(*axes, indexing="ij")
    return flexion, varus


def _function(name: str, terms: Float, grid: Grid, values: Float) -> JointFunction:
    """A function in powers of radians from Chebyshev terms (degrees or mm), and how far it is from the entries."""
    powers = _powers(terms.shape[0], grid.flexion_deg).T @ terms @ _powers(terms.shape[1], grid.varus_deg)
    size = int(np.add(*np.nonzero(terms)).max(initial=1)) + 1
    square = np.zeros((size, size))
    square[: powers.shape[0], : powers.shape[1]] = powers[:size, :size]
    flexion, varus = np.meshgrid(np.radians(grid.flexion_deg), np.radians(grid.varus_deg), indexing="ij")
    off = np.abs(polyval2d(flexion, varus, square) - values)
    factor = np.pi / 180.0 if name == "internal_rotation" else 1.0 / _MM_PER_M
    return JointFunction(name, square * factor, float(np.nanmax(off)), float(np.sqrt(np.nanmean(off**2))))


def _powers(count: int, axis_deg: Float) -> Float:
    """(count, count) row i: T_i of the scaled axis in powers of radians."""
    low, high = np.radians(ends(axis_deg))
    # a single value stands in the middle, as in `scaled`
    domain = (low, high) if high > low else (low - 1.0, high + 1.0)
    out = np.zeros((count, count))
    for degree in range(count):
        out[degree, : degree + 1] = Chebyshev.basis(degree, domain=domain).convert(kind=Polynomial).coef
    return out


def _remarks(content: LutFileContent, functions: Sequence[JointFunction]) -> str:
    usable = usable_entries(content.smooth.poses)
    lines = [
        "Research use - not for diagnosis.",
        f"Stable poses of a {content.side} {content.joint}, {content.software}. Metres and radians.",
        "Bodies: X anterior, Y proximal, Z right; origins and axes are those of the kinematic frames of lut.h5.",
        "Coordinates: flexion +, varus + (Grood and Suntay), for a right and for a left joint alike.",
        "Models whose knee angle is negative in flexion: negate the coordinate.",
        "Kinematics only: mass and inertia are placeholders.",
        f"The table has a pose at {int(usable.sum())} of {usable.size} attitudes; elsewhere the functions extrapolate.",
        "Largest and RMS deviation of the functions from the entries of the table (translations in the femoral axes):",
        *(f"  {one.name}: {one.deviation_max:.2g} and {one.deviation_rms:.2g} {one.unit}" for one in functions),
    ]
    return "\n" + "\n".join(lines) + "\n"


def _child(parent: ET.Element, tag: str, text: str | None = None, **attributes: str) -> ET.Element:
    element = ET.SubElement(parent, tag, attributes)
    element.text = text
    return element


def _objects(model: ET.Element, tag: str, name: str) -> ET.Element:
    return _child(_child(model, tag, name=name), "objects")


def _add_body(bodies: ET.Element, body: OsimBody) -> None:
    element = _child(bodies, "Body", name=body.name)
    geometry = _child(element, "attached_geometry")
    for name, color in body.structures:
        mesh = _child(geometry, "Mesh", name=name)
        _child(mesh, "socket_frame", "..")
        _child(_child(mesh, "Appearance"), "color", _text([channel / 255.0 for channel in color]))
        _child(mesh, "mesh_file", f"{name}.stl")
    _child(element, "mass", "1")
    _child(element, "mass_center", "0 0 0")
    _child(element, "inertia", "0.01 0.01 0.01 0 0 0")


def _add_joint(joints: ET.Element, kind: str, name: str, frames: tuple[str, str]) -> ET.Element:
    joint = _child(joints, kind, name=name)
    for socket, frame in zip(("parent", "child"), frames, strict=True):
        _child(joint, f"socket_{socket}_frame", frame)
    return joint


def _fill_joint(joint: ET.Element, content: LutFileContent, functions: Sequence[JointFunction]) -> None:
    names = [f"{content.joint}_{coordinate}_{content.side[0]}" for coordinate in ("flexion", "varus")]
    coordinates = _child(joint, "coordinates")
    grid = content.smooth.grid
    for name, axis, scan in zip(names, (grid.flexion_deg, grid.varus_deg), content.scan_attitude, strict=False):
        low, high = np.radians(ends(axis)).tolist()
        coordinate = _child(coordinates, "Coordinate", name=name)
        _child(coordinate, "default_value", _text([float(np.clip(np.radians(scan), low, high))]))
        _child(coordinate, "range", _text([low, high]))
        _child(coordinate, "clamped", "true")
    _add_transform(joint, names, _sign(content.side), {one.name: one for one in functions})


def _add_transform(joint: ET.Element, names: list[str], s: float, functions: Mapping[str, JointFunction]) -> None:
    transform = _child(joint, "SpatialTransform")
    for number, (name, direction) in enumerate(zip(names, ((0.0, 0.0, -1.0), (s, 0.0, 0.0)), strict=True), start=1):
        axis = _axis(transform, f"rotation{number}", name, direction)
        _child(_child(axis, "LinearFunction", name="function"), "coefficients", "1 0")
    rest = {
        "rotation3": ("internal_rotation", (0.0, s, 0.0)),
        "translation1": ("anterior", (1.0, 0.0, 0.0)),
        "translation2": ("proximal", (0.0, 1.0, 0.0)),
        "translation3": ("lateral", (0.0, 0.0, s)),
    }
    for tag, (name, direction) in rest.items():
        powers = functions[name].powers
        axis = _axis(transform, tag, " ".join(names), direction)
        function = _child(axis, "MultivariatePolynomialFunction", name="function")
        order = len(powers) - 1
        _child(function, "coefficients", _text([powers[i, j] for i in range(order + 1) for j in range(order + 1 - i)]))
        _child(function, "dimension", "2")
        _child(function, "order", str(order))


def _axis(transform: ET.Element, tag: str, coordinates: str, direction: tuple[float, float, float]) -> ET.Element:
    axis = _child(transform, "TransformAxis", name=tag)
    _child(axis, "coordinates", coordinates)
    _child(axis, "axis", _text(direction))
    return axis


def _text(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(number) + 0.0) for number in numbers)
