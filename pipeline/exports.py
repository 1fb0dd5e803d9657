"""A finished table in the formats of other programs: AR/VR and web, OpenSim, 3D Slicer, programs without HDF5.

Everything is made from the content of a package, so a package alone is enough to make it again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.decimation import decimate_quadric
from pipeline.case_id import check_case_id
from pipeline.errors import ConfigError
from pipeline.files.glb_file import GlbClip, GlbNode, GlbScene, encode_glb
from pipeline.files.lut_content import LutFileContent
from pipeline.files.lut_file import decode_lut
from pipeline.files.lut_json import SCHEMA_FILE, encode_lut_json, encode_lut_schema, unit_quaternions
from pipeline.files.markups import read_markups
from pipeline.files.meshes import read_mesh
from pipeline.files.osim_file import GEOMETRY_FOLDER, OsimBody, encode_body_stl, encode_osim
from pipeline.files.slicer_scene import encode_landmarks, encode_tfm
from pipeline.geometry.mesh import TriangleMesh, transformed
from pipeline.kinematics.interpolation import (
    PoseCurves,
    found_at,
    motion_map,
    motions,
    moved_from_scan_table,
    pose_curves,
    usable_entries,
    usable_runs,
)
from pipeline.records import Vector
from pipeline.report.palette import structure_color

Float = NDArray[np.float64]
Files = dict[str, bytes]

#: Triangles of all structures of a GLB or an OpenSim model together.
TRIANGLES = 40_000
#: Speed of the clips.
FLEXION_DEG_PER_S = 30.0
#: How far a point of the moving body may be from the table's pose between two keyframes.
KEYFRAME_ERROR_MM = 0.01
#: Flexion between two transforms for 3D Slicer.
SLICER_STEP_DEG = 30.0
LANDMARKS_FILE = "slicer/landmarks.mrk.json"

_GLB_VERSION = "1.0"
_MAX_PIECES = 64
_MM_PER_M = 1000.0
#: glTF: Y up, Z forward, X to the asset's left; so x left, y superior, z anterior.
_GLTF_FROM_LPS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])

_COORDINATES = (
    "Grood & Suntay: flexion about the mediolateral axis of the reference body, varus about the floating axis, "
    "internal rotation about delta, an axis of the moving body; flexion, varus and internal rotation are positive, for "
    "both sides alike"
)


@dataclass(frozen=True, eq=False)
class ExportSource:
    """What the formats are made of.

    Attributes
    ----------
    content : LutFileContent
    structures : mapping of str to TriangleMesh
        By name, scan space (LPS mm), as scanned.
    bodies : mapping of str to str
        Structure -> ``reference`` or ``moving``, the first of each its bone; those that a body only carries, as the
        tibia the fibula, come last; structures of neither are left out.
    landmarks : mapping of str to Vector
        LPS mm.
    """

    content: LutFileContent
    structures: Mapping[str, TriangleMesh]
    bodies: Mapping[str, str]
    landmarks: Mapping[str, Vector]

    def names(self, body: str) -> tuple[str, ...]:
        """Structures of one body, its bone first; ``other`` for those of neither."""
        named = (name for name in self.bodies if name in self.structures and self.bodies[name] == body)
        others = sorted(name for name in self.structures if name not in self.bodies)
        return tuple(others if body == "other" else named)


def finished_package(results: Path, case_id: str) -> Path:
    """The folder of a case's package.

    Raises
    ------
    ConfigError
        E-EXP-01 where there is none yet, E-ID-01 for an ID that is not plain.
    """
    folder = results / check_case_id(case_id) / "90_package"
    if not (folder / "manifest.json").is_file():
        raise ConfigError("E-EXP-01", f"{case_id} has no finished package yet.", f"Run it first: ct2lut run {case_id}.")
    return folder


def source_of(package: Mapping[str, bytes]) -> ExportSource:
    """The source from the files of a package by name, as ``lut.h5``.

    Raises
    ------
    ValueError
        When the table or the manifest is missing or damaged.
    CaseRejected
        For a damaged mesh or landmark file.
    """
    try:
        content, manifest = decode_lut(package["lut.h5"]), json.loads(package["manifest.json"])
        bodies = {one["structure"]: one["body"] for one in manifest["surfaces"] if one["origin"] != "absent"}
        bodies |= dict.fromkeys(manifest.get("carried", ()), "moving")
    except (KeyError, TypeError) as error:
        raise ValueError(f"the package is not complete: {error}") from error
    names = sorted(name for name in package if name.startswith("meshes/") and name.endswith(".ply"))
    structures = {name[len("meshes/") : -len(".ply")]: read_mesh(package[name], name).mesh for name in names}
    marks = package.get(LANDMARKS_FILE)
    return ExportSource(content, structures, bodies, read_markups(marks, LANDMARKS_FILE) if marks else {})


def export_files(source: ExportSource, formats: Collection[str] | None = None) -> Files:
    """Files of the wanted formats by their POSIX name; equal sources give equal bytes.

    Parameters
    ----------
    source : ExportSource
    formats : collection of str
        Of :data:`FORMATS`; None for all.

    Raises
    ------
    ValueError
        For an unknown format, or a table without a usable entry.
    """
    wanted = set(FORMATS if formats is None else formats)
    if unknown := sorted(wanted - set(FORMATS)):
        raise ValueError(f"unknown format {unknown[0]!r}, expected one of {', '.join(FORMATS)}")
    files: Files = {}
    for name, make in FORMATS.items():
        if name in wanted:
            files |= make(source)
    return files


def _glb(source: ExportSource) -> Files:
    content = source.content
    tracks, error_mm = _tracks(source)
    extras = {
        "schema": f"ct2lut-glb {_GLB_VERSION}",
        "notice": "Research use - not for diagnosis",
        "joint": content.joint,
        "side": content.side,
        "joint_coordinates": _COORDINATES,
        "gltf_m_from_lps_mm": _gltf_from_lps(content).tolist(),
        "moving_node": _bone(source, "moving"),
        "flexion_deg_per_s": FLEXION_DEG_PER_S,
        "flexion_deg_at_0_s": float(content.smooth.grid.flexion_deg[0]),
        "keyframe_error_mm": error_mm,
    }
    scene = GlbScene(_nodes(source), tuple(_clip(source, track) for track in tracks), content.software, extras)
    return {f"{content.joint}.glb": encode_glb(scene)}


def _json(source: ExportSource) -> Files:
    return {"lut.json": encode_lut_json(source.content), SCHEMA_FILE: encode_lut_schema()}


def _osim(source: ExportSource) -> Files:
    content, light = source.content, _lightened(source)
    bodies: list[OsimBody] = []
    files: Files = {}
    for body in ("reference", "moving"):
        names = source.names(body)
        parts = tuple((name, structure_color(name)) for name in names)
        bodies.append(OsimBody(f"{_bone(source, body)}_{content.side[0]}", parts))
        files |= {
            f"opensim/{GEOMETRY_FOLDER}/{name}.stl": encode_body_stl(light[name], content, body) for name in names
        }
    return {"opensim/joint.osim": encode_osim(content, bodies[0], bodies[1]), **files}


def _slicer(source: ExportSource) -> Files:
    """Landmarks, and the entries nearest to every 30 degrees of flexion in the column nearest to 0 varus."""
    content, files = source.content, {LANDMARKS_FILE: encode_landmarks(source.landmarks)}
    grid, table = content.smooth.grid, moved_from_scan_table(content.table)
    column = int(np.abs(grid.varus_deg).argmin())
    steps = np.arange(grid.flexion_deg[0], grid.flexion_deg[-1] + 1e-9, SLICER_STEP_DEG)
    for row in sorted({int(np.abs(grid.flexion_deg - step).argmin()) for step in steps}):
        if usable_entries(content.smooth.poses)[row, column]:
            attitude = f"flexion_{grid.flexion_deg[row]:g}_varus_{grid.varus_deg[column]:g}"
            files[f"slicer/{_bone(source, 'moving')}_{attitude}.tfm"] = encode_tfm(table[row, column])
    return files


#: What can be made, and by what.
FORMATS: dict[str, Callable[[ExportSource], Files]] = {"glb": _glb, "json": _json, "osim": _osim, "slicer": _slicer}


def _bone(source: ExportSource, body: str) -> str:
    """Name of a body: its first structure."""
    return next(iter(source.names(body)), body)


def _lightened(source: ExportSource) -> dict[str, TriangleMesh]:
    """Every structure with its share of :data:`TRIANGLES`."""
    share = TRIANGLES / max(sum(len(mesh.triangles) for mesh in source.structures.values()), 1)
    if share >= 1.0:
        return dict(source.structures)
    return {
        name: decimate_quadric(mesh, max(round(share * len(mesh.triangles)), 4))
        for name, mesh in source.structures.items()
    }


def _gltf_from_lps(content: LutFileContent) -> Float:
    """(4, 4) scan space (LPS mm) to glTF (m, Y up), the origin of the reference frame at 0: near the joint."""
    out = np.eye(4)
    out[:3, :3] = _GLTF_FROM_LPS / _MM_PER_M
    out[:3, 3] = -out[:3, :3] @ content.scan_from_reference[:3, 3]
    return out


def _nodes(source: ExportSource) -> GlbNode:
    """``knee_R`` above the bone of each body, which carries the rest of its body, and above what belongs to neither."""
    gltf_from_lps = _gltf_from_lps(source.content)
    light = {name: transformed(mesh, gltf_from_lps) for name, mesh in _lightened(source).items()}

    def leaf(name: str, children: tuple[GlbNode, ...] = ()) -> GlbNode:
        return GlbNode(name, light.get(name), structure_color(name), children)

    bones = [leaf(_bone(source, body), tuple(map(leaf, source.names(body)[1:]))) for body in ("reference", "moving")]
    root = f"{source.content.joint}_{source.content.side[0].upper()}"
    return GlbNode(root, children=(*bones, *map(leaf, source.names("other"))))


@dataclass(frozen=True, eq=False)
class _Track:
    """Keyframes of one varus and the poses half-way between them, glTF metres.

    Attributes
    ----------
    column : int
        Of the grid's varus.
    flexion_deg : (2K - 1,) float64
    motions : (2K - 1, 4, 4) float64
        Of the moving node; every second one, from the first on, is a keyframe.
    """

    column: int
    flexion_deg: Float
    motions: Float

    def keys(self) -> tuple[Float, Float, Float]:
        """Flexion (K,), translations (K, 3) and quaternions (K, 4), neighbours on one side of the sphere."""
        keys = self.motions[::2]
        turns = unit_quaternions(keys)
        flips = np.cumprod(np.where(np.einsum("ij,ij->i", turns[1:], turns[:-1]) < 0.0, -1.0, 1.0))
        turns[1:] *= flips[:, None]
        return self.flexion_deg[::2], keys[:, :3, 3], turns

    def error_mm(self, points: Float) -> float:
        """How far linear interpolation leads points (N, 3) beside the poses half-way, where it is worst."""
        from scipy.spatial.transform import Rotation  # noqa: PLC0415 - a cached run must not pay for it

        _, shifts, turns = self.keys()
        # half-way the mean of two quaternions, made one long again, is their slerp
        between = Rotation.from_quat(turns[1:] + turns[:-1]).as_matrix() - self.motions[1::2, :3, :3]
        shift = 0.5 * (shifts[1:] + shifts[:-1]) - self.motions[1::2, :3, 3]
        off = np.einsum("kij,nj->kni", between, points) + shift[:, None]
        return float(np.linalg.norm(off, axis=2).max()) * _MM_PER_M


def _tracks(source: ExportSource) -> tuple[tuple[_Track, ...], float]:
    """A track for each varus with two usable entries in a row, and the largest error between keyframes, mm.

    Intervals of the grid are halved until linear interpolation keeps to :data:`KEYFRAME_ERROR_MM`.
    """
    content, corners = source.content, _corners(source)
    curves = pose_curves(content.smooth.grid, content.smooth.poses)
    runs = _longest_runs(usable_entries(content.smooth.poses))
    pieces = 1
    while True:
        tracks = tuple(_track(content, curves, (column, run), 2 * pieces) for column, run in runs.items())
        error = max((track.error_mm(corners) for track in tracks), default=0.0)
        if error <= KEYFRAME_ERROR_MM or pieces >= _MAX_PIECES:
            return tracks, error
        pieces *= 2


def _track(content: LutFileContent, curves: PoseCurves, where: tuple[int, slice], pieces: int) -> _Track:
    """Poses of a run of one column, every interval of the grid in so many pieces."""
    column, run = where
    nodes = curves.grid.flexion_deg[run]
    flexion = np.interp(np.arange((len(nodes) - 1) * pieces + 1) / pieces, np.arange(len(nodes)), nodes)
    varus = np.full_like(flexion, curves.grid.varus_deg[column])
    to_scan = motion_map(content.scan_from_reference, content.scan_from_moving)
    gltf_from_lps = _gltf_from_lps(content)
    moved = motions(to_scan, flexion, varus, found_at(curves, flexion, varus))
    return _Track(column, flexion, gltf_from_lps @ moved @ np.linalg.inv(gltf_from_lps))


def _longest_runs(usable: NDArray[np.bool_]) -> dict[int, slice]:
    """Column -> its longest run of usable entries, where that has at least two."""
    runs = {column: max(usable_runs(one), key=_length, default=slice(0, 0)) for column, one in enumerate(usable.T)}
    return {column: run for column, run in runs.items() if _length(run) > 1}


def _length(run: slice) -> int:
    return int(run.stop - run.start)


def _corners(source: ExportSource) -> Float:
    """(8, 3) corners of a box around the moving body, glTF metres: no point inside is led further astray."""
    points = transformed(source.content.moving_body, _gltf_from_lps(source.content)).points
    low, high = points.min(axis=0), points.max(axis=0)
    return np.array([np.where(upper, high, low) for upper in np.ndindex(2, 2, 2)])


def _clip(source: ExportSource, track: _Track) -> GlbClip:
    grid = source.content.smooth.grid
    varus = float(grid.varus_deg[track.column])
    flexion, shifts, turns = track.keys()
    return GlbClip(
        f"flexion_varus_{varus:{'+' if varus else ''}g}deg",
        _bone(source, "moving"),
        (flexion - grid.flexion_deg[0]) / FLEXION_DEG_PER_S,
        shifts,
        turns,
        {
            "varus_deg": varus,
            "first_flexion_deg": float(flexion[0]),
            "last_flexion_deg": float(flexion[-1]),
            "covers_the_table": bool(flexion[0] == grid.flexion_deg[0] and flexion[-1] == grid.flexion_deg[-1]),
        },
    )
