"""The npz codec: exact, deterministic, strict."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.engine.artifacts import Artifact
from pipeline.files.arrays import (
    array_artifact,
    label_volume_artifact,
    mesh_artifact,
    mesh_set_artifact,
    pack,
    unpack,
)
from pipeline.geometry.mesh import TriangleMesh
from tests.files.label_samples import knee_like


@dataclass(frozen=True, eq=False)
class Part:
    name: str
    weights: NDArray[np.float64]
    rms: float


@dataclass(frozen=True, eq=False)
class Whole:
    title: str
    count: int
    good: bool
    status: NDArray[np.uint8]
    any_kind: NDArray[np.generic]
    part: Part
    parts: tuple[Part, ...]
    maybe: Part | None


WHOLE: Artifact[Whole] = array_artifact("whole", "whole.npz", Whole)


def part(name: str) -> Part:
    return Part(name, np.array([[1.5, np.nan], [-0.0, np.inf]]), 0.25)


def whole(maybe: Part | None = None) -> Whole:
    status = np.arange(6, dtype=np.uint8).reshape(2, 3)
    return Whole("knie é", 3, True, status, np.arange(4, dtype=np.int32), part("a"), (part("b"), part("c")), maybe)


def tetrahedron() -> TriangleMesh:
    points = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
    return TriangleMesh(points, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32))


@pytest.mark.parametrize("maybe", [None, part("m")])
def test_round_trip_is_exact(maybe: Part | None) -> None:
    found = WHOLE.decode(WHOLE.encode(whole(maybe)))
    expected = whole(maybe)
    assert (found.title, found.count, found.good, found.part.name) == ("knie é", 3, True, "a")
    assert isinstance(found.count, int)
    assert isinstance(found.good, bool)
    assert [one.name for one in found.parts] == ["b", "c"]
    np.testing.assert_array_equal(found.parts[1].weights, expected.parts[1].weights)
    np.testing.assert_array_equal(found.status, expected.status)
    assert [array.dtype.name for array in (found.status, found.any_kind)] == ["uint8", "int32"]
    assert (found.maybe is None) == (maybe is None)
    assert WHOLE.encode(found) == WHOLE.encode(expected)


def test_bytes_do_not_depend_on_memory_layout() -> None:
    columns = Part("a", np.asfortranarray(part("a").weights), 0.25)
    assert array_artifact("p", "p.npz", Part).encode(columns) == array_artifact("p", "p.npz", Part).encode(part("a"))


def test_numpy_reads_it() -> None:
    with np.load(io.BytesIO(WHOLE.encode(whole())[""])) as archive:
        assert archive["parts.0.name"] == "b"
        np.testing.assert_array_equal(archive["status"], whole().status)


@pytest.mark.parametrize(
    ("key", "array", "problem"),
    [
        ("status", None, "status is missing"),
        ("part.rms", None, "part.rms is missing"),
        ("extra", np.zeros(1), "unexpected arrays: extra"),
        ("status", np.zeros((2, 3)), "status: expected .*uint8.*, got float64"),
        ("count", np.zeros(2, np.int64), r"count: expected .*int.*, got int64 of shape \(2,\)"),
        ("title", np.zeros(()), "title: expected .*str"),
        ("any_kind", np.array(["a"]), "any_kind: expected"),
    ],
)
def test_other_members_are_refused(key: str, array: NDArray[np.generic] | None, problem: str) -> None:
    members = unpack(WHOLE.encode(whole())[""])
    if array is None:
        del members[key]
    else:
        members[key] = array
    with pytest.raises(ValueError, match=problem):
        WHOLE.decode({"": pack(members)})


def test_a_wrong_type_is_refused_before_it_is_written() -> None:
    wrong = Part("a", np.arange(3), 0.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"weights: expected .*float64.*, got int64"):
        array_artifact("p", "p.npz", Part).encode(wrong)


def test_a_list_cannot_be_stored() -> None:
    @dataclass(frozen=True)
    class Odd:
        items: list[int]

    # the annotation is local, so it is resolved here and not in the module
    Odd.__annotations__["items"] = list
    with pytest.raises(TypeError, match=r"items: annotation .* cannot be stored"):
        array_artifact("odd", "odd.npz", Odd).encode(Odd([1]))


def test_truncated_or_altered_bytes_are_refused() -> None:
    data = WHOLE.encode(whole())[""]
    for end in range(0, len(data), 97):
        with pytest.raises(ValueError, match="not a readable array archive"):
            WHOLE.decode({"": data[:end]})
    altered = bytearray(data)
    altered[data.index(b"NUMPY") + 130] ^= 1
    with pytest.raises(ValueError, match=r"not a readable array archive: Bad CRC-32"):
        WHOLE.decode({"": bytes(altered)})


def test_objects_are_neither_written_nor_read() -> None:
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        pack({"a": np.array([{}], dtype=object)})
    buffer = io.BytesIO()
    np.savez(buffer, a=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="holds objects"):
        unpack(buffer.getvalue())


def test_a_member_that_lies_about_its_size_is_refused() -> None:
    member = io.BytesIO()
    np.save(member, np.zeros(4))
    lie = member.getvalue().replace(b"(4,)", b"(9,)")
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.npy", lie)
    with pytest.raises(ValueError, match="declares 72 bytes and holds 32"):
        unpack(buffer.getvalue())


def test_mesh_round_trip() -> None:
    artifact = mesh_artifact("body", "body.npz")
    found = artifact.decode(artifact.encode(tetrahedron()))
    np.testing.assert_array_equal(found.points, tetrahedron().points)
    np.testing.assert_array_equal(found.triangles, tetrahedron().triangles)


@pytest.mark.parametrize(
    ("mesh", "problem"),
    [
        (TriangleMesh(np.zeros((3, 2)), np.zeros((1, 3), np.int32)), r"body: expected points \(N, 3\)"),
        (TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 3]], np.int32)), r"body: triangle indices outside 0\.\.2"),
        (TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, -1]], np.int32)), r"body: triangle indices outside 0\.\.2"),
    ],
)
def test_arrays_that_are_no_mesh(mesh: TriangleMesh, problem: str) -> None:
    artifact = mesh_artifact("body", "body.npz")
    with pytest.raises(ValueError, match=problem):
        artifact.decode(artifact.encode(mesh))


def test_mesh_set_round_trip() -> None:
    artifact = mesh_set_artifact("meshes", "meshes.npz")
    found = artifact.decode(artifact.encode({"tibia": tetrahedron(), "femur": tetrahedron()}))
    assert list(found) == ["femur", "tibia"]
    np.testing.assert_array_equal(found["tibia"].points, tetrahedron().points)
    assert artifact.decode(artifact.encode({})) == {}
    with pytest.raises(ValueError, match="no dot"):
        artifact.encode({"a.b": tetrahedron()})


def test_label_volume_or_none() -> None:
    artifact = label_volume_artifact("labels", "labels.nrrd")
    assert artifact.encode(None) == {"": b""}
    assert artifact.decode({"": b""}) is None
    found = artifact.decode(artifact.encode(knee_like()))
    assert found is not None
    np.testing.assert_array_equal(found.values, knee_like().values)
    with pytest.raises(ValueError, match="damaged or incomplete"):
        artifact.decode({"": artifact.encode(knee_like())[""][:-9]})
