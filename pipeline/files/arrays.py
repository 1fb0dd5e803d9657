"""Frozen dataclasses of arrays to deterministic ``.npz`` bytes and back, strictly.

A field is one member of the archive, named by its path (``poses.status``, ``fits.0.name``), so ``numpy.load`` shows
the same tree. Members are stored, not deflated: deflated bytes differ between builds of zlib, and floats hardly shrink.
A tuple of dataclasses, and a field that may be None, first writes its length (0 or 1 for the latter).
"""

from __future__ import annotations

import io
import types
import zipfile
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from pipeline.engine.artifacts import Artifact, single
from pipeline.errors import CaseRejected
from pipeline.files.nrrd_format import encode_nrrd, read_nrrd
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.volume import CtVolume, LabelVolume

T = TypeVar("T")

#: Path of a field -> its array.
Members = dict[str, NDArray[Any]]

_DATE = (1980, 1, 1, 0, 0, 0)
_SCALARS: dict[type, str] = {bool: "b", int: "i", float: "f", str: "U"}
_NUMBERS = "biuf"


def array_artifact(name: str, file: str, kind: type[T], schema: int = 1) -> Artifact[T]:
    """An artifact that is one ``.npz`` file holding one frozen dataclass.

    Parameters
    ----------
    name, file : str
    kind : type
        A dataclass whose fields are arrays (``NDArray[dtype]``), bool, int, float, str, dataclasses of the same sort,
        ``tuple[X, ...]`` or ``X | None`` of these.
    schema : int

    Returns
    -------
    Artifact
        Its decoder raises ValueError unless members, dtypes and sizes are exactly those of ``kind``.
    """
    return single(name, file, lambda value: _encode(value, kind), lambda data: _decode(data, kind), schema)


def mesh_artifact(name: str, file: str) -> Artifact[TriangleMesh]:
    """An artifact that is one triangle mesh (``.npz``)."""
    return single(
        name,
        file,
        lambda mesh: _encode(mesh, TriangleMesh),
        lambda data: _checked_mesh(_decode(data, TriangleMesh), name),
    )


def mesh_set_artifact(name: str, file: str) -> Artifact[dict[str, TriangleMesh]]:
    """An artifact that is a set of triangle meshes by structure name (one ``.npz``; keys ``femur.points`` ...)."""
    return single(name, file, _encode_mesh_set, _decode_mesh_set)


def label_volume_artifact(name: str, file: str) -> Artifact[LabelVolume | None]:
    """An artifact that is one label volume (``.nrrd``), or an empty file for None."""
    return single(name, file, lambda volume: b"" if volume is None else encode_nrrd(volume), _decode_label_volume)


def ct_volume_artifact(name: str, file: str) -> Artifact[CtVolume | None]:
    """An artifact that is one CT (``.nrrd``), or an empty file for None."""
    return single(name, file, lambda volume: b"" if volume is None else encode_nrrd(volume), _decode_ct_volume)


def pack(members: Mapping[str, NDArray[Any]]) -> bytes:
    """``.npz`` bytes of arrays by name: sorted, stored, with fixed dates; equal arrays give equal bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for key in sorted(members):
            archive.writestr(zipfile.ZipInfo(f"{key}.npy", _DATE), _npy_bytes(members[key]))
    return buffer.getvalue()


def unpack(data: bytes) -> Members:
    """Arrays by name from ``.npz`` bytes.

    Raises
    ------
    ValueError
        For bytes that are not such an archive, are damaged, or hold objects.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {entry.filename.removesuffix(".npy"): _npy_array(archive.read(entry)) for entry in archive.filelist}
    except (zipfile.BadZipFile, EOFError, NotImplementedError, OSError, RuntimeError) as error:
        raise ValueError(f"not a readable array archive: {error}") from error


def _npy_bytes(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    npy.write_array(buffer, np.asarray(array, order="C"), version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def _npy_array(data: bytes) -> NDArray[Any]:
    stream = io.BytesIO(data)
    if npy.read_magic(stream) != (1, 0):
        raise ValueError("array member has an unknown version")
    shape, fortran, dtype = npy.read_array_header_1_0(stream)
    if dtype.hasobject or fortran:
        raise ValueError("array member holds objects or is in Fortran order")
    # frombuffer instead of read_array: a header that lies about the shape is refused before anything is allocated
    if (expected := int(np.prod(shape, dtype=object)) * dtype.itemsize) != len(data) - stream.tell():
        raise ValueError(f"array member declares {expected} bytes and holds {len(data) - stream.tell()}")
    return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape).copy()


def _encode(value: T, kind: type[T]) -> bytes:
    members: Members = {}
    _put(members, "", kind, value)
    return pack(members)


def _decode(data: bytes, kind: type[T]) -> T:
    members = unpack(data)
    value: T = _take(members, "", kind)
    if members:
        raise ValueError(f"unexpected arrays: {', '.join(sorted(members))}")
    return value


def _join(path: str, name: str | int) -> str:
    return f"{path}.{name}" if path else str(name)


def _item_kind(kind: Any) -> Any:
    """X of ``tuple[X, ...]`` and of ``X | None``; None for every other annotation."""
    arguments = get_args(kind)
    if get_origin(kind) is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        return arguments[0]
    if get_origin(kind) in (Union, types.UnionType) and len(arguments) == 2 and arguments[1] is type(None):
        return arguments[0]
    return None


def _put(members: Members, path: str, kind: Any, value: Any) -> None:
    """Add the arrays of ``value``, annotated as ``kind``, under ``path``."""
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        for field in fields(kind):
            _put(members, _join(path, field.name), hints[field.name], getattr(value, field.name))
    elif (item := _item_kind(kind)) is not None:
        items = value if get_origin(kind) is tuple else () if value is None else (value,)
        members[path] = np.asarray(len(items), dtype=np.int64)
        for index, one in enumerate(items):
            _put(members, _join(path, index), item, one)
    else:
        array = np.asarray(value)
        members[path] = _checked(
            array.astype(np.float64) if kind is float and array.dtype.kind in "iu" else array, path, kind
        )


def _take(members: Members, path: str, kind: Any) -> Any:
    """Remove the arrays under ``path`` and return the value, annotated as ``kind``, that they encode."""
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{f.name: _take(members, _join(path, f.name), hints[f.name]) for f in fields(kind)})
    if (item := _item_kind(kind)) is not None:
        count = int(_checked(_pop(members, path), path, int))
        items = tuple(_take(members, _join(path, index), item) for index in range(count))
        return items if get_origin(kind) is tuple else items[0] if items else None
    array = _checked(_pop(members, path), path, kind)
    return array.item() if kind in _SCALARS else array


def _pop(members: Members, path: str) -> NDArray[Any]:
    try:
        return members.pop(path)
    except KeyError:
        raise ValueError(f"array {path} is missing") from None


def _checked(array: NDArray[Any], path: str, kind: Any) -> NDArray[Any]:
    """The array, when its dtype is the one that the annotation asks for."""
    if kind in _SCALARS:
        fits = array.shape == () and array.dtype.kind == _SCALARS[kind]
    elif get_origin(kind) is np.ndarray:
        wanted = get_args(get_args(kind)[1])[0]
        fits = array.dtype.kind in _NUMBERS if wanted is np.generic else array.dtype == np.dtype(wanted)
    else:
        raise TypeError(f"{path}: annotation {kind} cannot be stored as an array")
    if not fits:
        raise ValueError(f"{path}: expected {kind}, got {array.dtype} of shape {array.shape}")
    return array


def _checked_mesh(mesh: TriangleMesh, name: str) -> TriangleMesh:
    """The mesh, when its arrays have the shapes of a mesh and its indices lie in range."""
    points, triangles = mesh.points, mesh.triangles
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"{name}: expected points (N, 3), triangles (M, 3), got {points.shape}, {triangles.shape}")
    if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(points)):
        raise ValueError(f"{name}: triangle indices outside 0..{len(points) - 1}")
    return mesh


def _encode_mesh_set(meshes: dict[str, TriangleMesh]) -> bytes:
    members: Members = {}
    for name, mesh in meshes.items():
        if not name or "." in name:
            raise ValueError(f"a structure name has no dot and is not empty, got {name!r}")
        _put(members, name, TriangleMesh, mesh)
    return pack(members)


def _decode_mesh_set(data: bytes) -> dict[str, TriangleMesh]:
    members = unpack(data)
    names = sorted({key.partition(".")[0] for key in members})
    meshes = {name: _checked_mesh(_take(members, name, TriangleMesh), name) for name in names}
    if members:
        raise ValueError(f"unexpected arrays: {', '.join(sorted(members))}")
    return meshes


def _decode_label_volume(data: bytes) -> LabelVolume | None:
    if not data:
        return None
    values, lps_from_index = _decoded_nrrd(data)
    if values.dtype.name not in ("uint8", "uint16"):
        raise ValueError(f"expected labels of 8 or 16 bits, got {values.dtype}")
    return LabelVolume(values, lps_from_index)


def _decode_ct_volume(data: bytes) -> CtVolume | None:
    if not data:
        return None
    values, lps_from_index = _decoded_nrrd(data)
    if values.dtype.name != "int16":
        raise ValueError(f"expected CT numbers of 16 bits, got {values.dtype}")
    return CtVolume(values, lps_from_index)


def _decoded_nrrd(data: bytes) -> tuple[NDArray[Any], NDArray[np.float64]]:
    try:
        image = read_nrrd(data, "volume.nrrd")
    except CaseRejected as error:
        raise ValueError(error.problem) from error
    return image.values, image.lps_from_index
