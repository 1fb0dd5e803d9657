"""PLY and STL: what others write is read, what is broken is refused, what we write is exact."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from pipeline.errors import CaseRejected
from pipeline.files.meshes import encode_ply, encode_stl, read_mesh
from pipeline.geometry.mesh import TriangleMesh


def box() -> TriangleMesh:
    """A closed box 20 x 30 x 40 mm off the origin; coordinates that float32 holds exactly."""
    made = trimesh.creation.box((20.0, 30.0, 40.0))
    return TriangleMesh(
        np.asarray(made.vertices) + np.array([5.5, -7.25, 640.0]), np.asarray(made.faces, dtype=np.int32)
    )


def trimesh_bytes(mesh: TriangleMesh, kind: str, **options: str) -> bytes:
    data = trimesh.Trimesh(mesh.points, mesh.triangles, process=False).export(file_type=kind, **options)
    return data if isinstance(data, bytes) else str(data).encode()


BOX = box()
FILES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "our ply": ("femur.ply", lambda: encode_ply(BOX)),
    "our stl": ("femur.stl", lambda: encode_stl(BOX)),
    "ply": ("femur.ply", lambda: trimesh_bytes(BOX, "ply")),
    "ply ascii": ("femur.ply", lambda: trimesh_bytes(BOX, "ply", encoding="ascii")),
    "stl": ("femur.stl", lambda: trimesh_bytes(BOX, "stl")),
    "stl ascii": ("femur.stl", lambda: trimesh_bytes(BOX, "stl_ascii")),
}


def facets(mesh: TriangleMesh) -> list[list[tuple[float, ...]]]:
    """Triangles as corner coordinates, in an order that does not depend on numbering."""
    out = []
    for triangle in mesh.triangles:
        corners = [tuple(map(float, mesh.points[index])) for index in triangle]
        first = corners.index(min(corners))
        out.append(corners[first:] + corners[:first])
    return sorted(out)


def refused(code: str, problem: str) -> pytest.RaisesExc[CaseRejected]:
    return pytest.raises(CaseRejected, match=f"^{code} .*{problem}")


@pytest.mark.parametrize("kind", FILES)
def test_every_format_gives_the_same_surface(kind: str) -> None:
    name, data = FILES[kind]
    found = read_mesh(data(), name)
    assert facets(found.mesh) == facets(BOX)
    assert found.mesh.points.shape == (8, 3)
    assert [finding.code for finding in found.findings] == ([] if kind.startswith("our") else ["N-GEO-03"])


@pytest.mark.parametrize("kind", FILES)
def test_truncated_anywhere(kind: str) -> None:
    name, data = FILES[kind]
    content = data()
    for part in range(16):
        with refused("E-IO-11", name):
            read_mesh(content[: len(content) * part // 16], name)


@pytest.mark.parametrize("kind", [kind for kind in FILES if "ascii" not in kind])
def test_trailing_bytes(kind: str) -> None:
    name, data = FILES[kind]
    with refused("E-IO-11", name):
        read_mesh(data() + b"0", name)


def test_ply_keeps_every_bit() -> None:
    exact = TriangleMesh(BOX.points + np.pi * 1e-9, BOX.triangles)
    found = read_mesh(encode_ply(exact), "x.ply").mesh
    np.testing.assert_array_equal(found.points, exact.points)
    np.testing.assert_array_equal(found.triangles, exact.triangles)
    assert encode_ply(found) == encode_ply(exact)


def test_others_read_what_we_write() -> None:
    for encoded, kind in ((encode_ply(BOX), "ply"), (encode_stl(BOX), "stl")):
        made = trimesh.load(trimesh.util.wrap_as_stream(encoded), file_type=kind)
        assert made.is_watertight
        assert made.volume == pytest.approx(20.0 * 30.0 * 40.0)
        np.testing.assert_allclose(made.bounds[0], BOX.points.min(axis=0))


def test_stl_normals_point_outward() -> None:
    data = encode_stl(BOX)
    rows = np.frombuffer(data[84:], np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("rest", "<u2")]))
    outward = rows["points"].mean(axis=1) - BOX.points.mean(axis=0)
    assert (np.einsum("ij,ij->i", rows["normal"], outward) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(rows["normal"], axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("space", "signs", "codes"), [("RAS", (-1.0, -1.0, 1.0), ["N-GEO-04"]), ("LPS", (1.0, 1.0, 1.0), [])]
)
def test_the_space_that_a_file_names(space: str, signs: tuple[float, float, float], codes: list[str]) -> None:
    turned = TriangleMesh(BOX.points * signs, BOX.triangles)
    for name, data in (("x.ply", encode_ply(turned)), ("x.stl", encode_stl(turned))):
        found = read_mesh(data.replace(b"SPACE=LPS", b"SPACE=" + space.encode()), name)
        assert facets(found.mesh) == facets(BOX)
        assert [finding.code for finding in found.findings] == codes


def test_a_space_that_is_neither() -> None:
    with refused("E-IO-13", "its space is XYZ"):
        read_mesh(encode_ply(BOX).replace(b"SPACE=LPS", b"SPACE=XYZ"), "x.ply")


@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_wrong_units(factor: float) -> None:
    with refused("E-GEO-07", "looks like"):
        read_mesh(encode_ply(TriangleMesh(BOX.points * factor, BOX.triangles)), "x.ply")


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("name", "encode"), [("x.ply", encode_ply), ("x.stl", encode_stl)])
def test_coordinates_that_are_not_finite(value: float, name: str, encode: Callable[[TriangleMesh], bytes]) -> None:
    points = BOX.points.copy()
    points[3, 1] = value
    with np.errstate(invalid="ignore"):
        data = encode(TriangleMesh(points, BOX.triangles))
    with refused("E-IO-18", "not a finite number"):
        read_mesh(data, name)


@pytest.mark.parametrize("index", [8, -1])
def test_indices_out_of_range(index: int) -> None:
    triangles = BOX.triangles.copy()
    triangles[2, 1] = index
    with refused("E-IO-18", r"outside 0\.\.7"):
        read_mesh(encode_ply(TriangleMesh(BOX.points, triangles)), "x.ply")


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_triangles(count: int) -> None:
    few = TriangleMesh(BOX.points, BOX.triangles[:count])
    for name, data in (("x.ply", encode_ply(few)), ("x.stl", encode_stl(few))):
        with refused("E-IO-18", f"it has {count} triangles"):
            read_mesh(data, name)


@pytest.mark.parametrize(
    ("old", "new", "code", "problem"),
    [
        (b"element vertex 8", b"element vertex 9", "E-IO-1[12]", "x.ply"),
        (b"element face 12", b"element face 13", "E-IO-11", "declares 13 of face, and has 12"),
        (b"element face 12", b"element face 11", "E-IO-11", "13 bytes more"),
        (b"element face 12", b"element face 999999999999", "E-IO-11", "has 12"),
        (b"element face", b"element vertex", "E-IO-13", "twice"),
        (b"property double y", b"property double x", "E-IO-13", "twice"),
        (b"property double y", b"property double w", "E-IO-13", "no vertices x, y, z"),
        (b"property double y", b"property quad y", "E-IO-13", "not PLY"),
        (b"vertex_indices", b"something", "E-IO-13", "no faces"),
        (b"format binary_little_endian 1.0", b"format other 1.0", "E-IO-13", "not PLY"),
        (b"format binary_little_endian 1.0", b"format binary_little_endian 9.0", "E-IO-13", "not PLY"),
        (b"comment", b"element nothing 5\ncomment", "E-IO-13", "not PLY"),
        (b"comment", b"strange", "E-IO-13", "not PLY"),
    ],
)
def test_ply_headers_that_lie(old: bytes, new: bytes, code: str, problem: str) -> None:
    data = encode_ply(BOX)
    assert old in data
    with refused(code, problem):
        read_mesh(data.replace(old, new), "x.ply")


def test_faces_that_are_not_triangles() -> None:
    header = b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    header += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    with refused("E-IO-11", "triangles only"):
        read_mesh(header + b"0 0 0\n9 0 0\n9 9 0\n0 9 0\n4 0 1 2 3\n", "x.ply")
    quads = encode_ply(BOX)
    end = quads.index(b"end_header\n") + len(b"end_header\n") + 8 * 24
    with refused("E-IO-12", "not triangles"):
        read_mesh(quads[:end] + b"\x04" + quads[end + 1 :], "x.ply")


def test_ascii_ply_with_other_columns() -> None:
    """Colours and further tables do not disturb; a fraction where an index belongs does."""
    lines = ["ply", "format ascii 1.0", "comment SPACE=LPS", "element vertex 8"]
    lines += [f"property float {axis}" for axis in "xyz"] + ["property uchar red"]
    lines += ["element face 12", "property list uchar int vertex_index", "property uchar flag", "end_header"]
    lines += [f"{x} {y} {z} 200" for x, y, z in BOX.points]
    faces = [f"3 {a} {b} {c} 1" for a, b, c in BOX.triangles]
    assert facets(read_mesh("\n".join(lines + faces).encode(), "x.ply").mesh) == facets(BOX)
    faces[0] = "3 0.5 1 2 1"
    with refused("E-IO-11", "not whole numbers"):
        read_mesh("\n".join(lines + faces).encode(), "x.ply")


def test_other_endings() -> None:
    with refused("E-IO-12", "expected a mesh that ends in .ply or .stl"):
        read_mesh(encode_ply(BOX), "x.obj")
