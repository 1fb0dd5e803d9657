"""Triangle meshes from PLY and STL bytes, and to them.

Read strictly, because the usual libraries return an empty or a shorter mesh for a truncated file without an error; the
two formats are a table each. Files that name their space (``SPACE=RAS``, as 3D Slicer does) are turned to LPS.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.foreign_image import bad_header, damaged, unsupported
from pipeline.files.ply_format import read_ply_tables
from pipeline.geometry.mesh import TriangleMesh

#: File name endings of meshes that are read.
MESH_ENDINGS = (".ply", ".stl")
MAX_BYTES = 500_000_000
MAX_TRIANGLES = 5_000_000
#: Largest side of a structure: a mesh in metres is below, one in micrometres above.
EXTENT_MM = (5.0, 2500.0)

_COMMENT = "SPACE=LPS, millimetres, scan space"
_STL_FACET = np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER = 80
#: The words of one facet in ASCII STL, at these of its 21 places; the other places are numbers.
_FACET_WORDS = {0: "facet", 1: "normal", 5: "outer", 6: "loop", 7: "vertex", 11: "vertex", 15: "vertex"} | {
    19: "endloop",
    20: "endfacet",
}
_VERTEX_PLACES = (8, 9, 10, 12, 13, 14, 16, 17, 18)


@dataclass(frozen=True, eq=False)
class ForeignMesh:
    """A mesh that a case brought, in LPS mm, and what had to be assumed about it."""

    mesh: TriangleMesh
    findings: tuple[Finding, ...]


def read_mesh(data: bytes, file: str) -> ForeignMesh:
    """Read one PLY or STL mesh.

    Parameters
    ----------
    data : bytes
        The whole file; binary or ASCII.
    file : str
        Its name relative to the case folder; the ending chooses the format.

    Returns
    -------
    ForeignMesh
        Not yet checked to be closed. Vertices of STL facets that coincide exactly are one vertex.

    Raises
    ------
    CaseRejected
        E-IO-11..14 for damaged, unsupported or too large files, E-IO-18 for a surface that is none, E-GEO-07 for a
        size that is not in millimetres.
    """
    if len(data) > MAX_BYTES:
        raise CaseRejected(
            "E-IO-14",
            f"{file} has {len(data) / 1e6:.0f} MB, expected at most {MAX_BYTES / 1e6:.0f} MB.",
            "Reduce the number of triangles.",
        )
    if file.lower().endswith(".ply"):
        mesh, comment = _read_ply(data, file)
    elif file.lower().endswith(".stl"):
        mesh, comment = _read_stl(data, file)
    else:
        raise unsupported(file, f"expected a mesh that ends in {' or '.join(MESH_ENDINGS)}")
    _check_surface(mesh, file)
    return _in_lps(mesh, comment, file)


def encode_ply(mesh: TriangleMesh) -> bytes:
    """Binary little-endian PLY with float64 vertices; equal meshes give equal bytes."""
    header = (
        "ply",
        "format binary_little_endian 1.0",
        f"comment {_COMMENT}",
        f"element vertex {len(mesh.points)}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {len(mesh.triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    )
    faces = np.empty(len(mesh.triangles), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.triangles
    return ("\n".join(header) + "\n").encode() + mesh.points.astype("<f8").tobytes() + faces.tobytes()


def encode_stl(mesh: TriangleMesh) -> bytes:
    """Binary STL with outward facet normals (float32, as the format has it); equal meshes give equal bytes."""
    corners = mesh.points[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facets = np.zeros(len(corners), dtype=_STL_FACET)
    facets["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    facets["points"] = corners
    # a header that began with "solid" would be taken for ASCII
    header = f"binary STL, {_COMMENT}".encode().ljust(_STL_HEADER)
    return header + len(facets).to_bytes(4, "little") + facets.tobytes()


def _read_ply(data: bytes, file: str) -> tuple[TriangleMesh, str]:
    tables, comment = read_ply_tables(data, file)
    try:
        vertex, faces = tables["vertex"], tables["face"]
        points = np.column_stack([vertex[axis].astype(np.float64) for axis in "xyz"])
        name = "vertex_indices" if "vertex_indices" in (faces.dtype.names or ()) else "vertex_index"
        triangles = faces[name]
    except (KeyError, ValueError) as error:
        raise bad_header(file, "it has no vertices x, y, z or no faces with vertex_indices") from error
    return _indexed(points, triangles.reshape(-1, 3), file), comment


def _read_stl(data: bytes, file: str) -> tuple[TriangleMesh, str]:
    count = int.from_bytes(data[_STL_HEADER : _STL_HEADER + 4], "little")
    body = data[_STL_HEADER + 4 :]
    if len(data) >= _STL_HEADER + 4 and len(body) == count * _STL_FACET.itemsize:
        corners: NDArray[Any] = np.frombuffer(body, _STL_FACET)["points"]
        comment = data[:_STL_HEADER].decode("latin-1")
    elif data.startswith(b"solid"):
        corners, comment = _ascii_stl(data, file), data.split(b"\n", 1)[0].decode("latin-1")
    else:
        raise damaged(file, f"expected {count} triangles in {len(data)} bytes")
    # + 0.0 makes -0.0 and 0.0 one vertex
    points, index = np.unique(corners.reshape(-1, 3).astype(np.float64) + 0.0, axis=0, return_inverse=True)
    return _indexed(points, index.reshape(-1, 3), file), comment


def _ascii_stl(data: bytes, file: str) -> NDArray[np.float64]:
    """(M, 3, 3) corners; every word must be where the grammar has it, to the final ``endsolid``."""
    try:
        lines = data.decode("ascii").strip().splitlines()
        words = np.array(" ".join(lines[1:-1]).split()).reshape(-1, 21)
        in_place = all((words[:, place] == word).all() for place, word in _FACET_WORDS.items())
        corners = words[:, _VERTEX_PLACES].astype(np.float64)
    except ValueError as error:
        raise damaged(file, "it is not complete ASCII STL") from error
    if not in_place or not lines[-1].strip().startswith("endsolid"):
        raise damaged(file, "it is not complete ASCII STL")
    return corners.reshape(-1, 3, 3)


def _indexed(points: NDArray[np.float64], triangles: NDArray[Any], file: str) -> TriangleMesh:
    in_range = len(triangles) == 0 or 0 <= triangles.min() <= triangles.max() < len(points)
    if triangles.dtype.kind not in "iu" or not in_range:
        raise _no_surface(file, f"a triangle refers to a vertex outside 0..{len(points) - 1}")
    return TriangleMesh(points, triangles.astype(np.int32))


def _check_surface(mesh: TriangleMesh, file: str) -> None:
    if not 4 <= len(mesh.triangles) <= MAX_TRIANGLES:
        raise _no_surface(file, f"it has {len(mesh.triangles)} triangles, expected 4 to {MAX_TRIANGLES}")
    if not np.isfinite(mesh.points).all():
        raise _no_surface(file, "a coordinate is not a finite number")
    low, high = EXTENT_MM
    largest = float(np.ptp(mesh.points, axis=0).max())
    if not low <= largest <= high:
        guess = " (it looks like metres)" if largest < low else " (it looks like micrometres)"
        raise CaseRejected(
            "E-GEO-07",
            f"The largest side of {file} is {largest:.4g} mm, expected {low:g} to {high:g} mm{guess}.",
            "Export the mesh in millimetres.",
        )


def _in_lps(mesh: TriangleMesh, comment: str, file: str) -> ForeignMesh:
    """The mesh in LPS, as the file's comment says, or as 3D Slicer takes a file that says nothing."""
    space = re.search(r"SPACE=([A-Za-z]+)", comment)
    if space is None:
        text = f"{file} does not name its space; LPS (as in DICOM) was assumed."
        return ForeignMesh(mesh, (Finding("N-GEO-03", Severity.NOTE, text),))
    if space[1] == "LPS":
        return ForeignMesh(mesh, ())
    if space[1] != "RAS":
        raise bad_header(file, f"its space is {space[1][:20]}, expected LPS or RAS")
    # half a turn about z: the winding of the triangles stays
    turned = TriangleMesh(mesh.points * (-1.0, -1.0, 1.0) + 0.0, mesh.triangles)
    return ForeignMesh(turned, (Finding("N-GEO-04", Severity.NOTE, f"{file} was turned from RAS to LPS."),))


def _no_surface(file: str, problem: str) -> CaseRejected:
    problem = f"{file} holds no usable surface: {problem}."
    return CaseRejected("E-IO-18", problem, "Export the mesh again as PLY or STL.")
