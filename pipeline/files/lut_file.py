"""``lut.h5`` bytes from a table and back; the only place that knows HDF5.

Writing: built in memory, without times, with a fixed file version, checksums (fletcher32) on the data and, by that
version, on the structure; equal tables give equal bytes. Reading: nothing is followed out of the file (hard links
only, no external or virtual storage, no filter but our own), and nothing is allocated before its type and size were
checked.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.files.lut_content import LutFileContent, check_content
from pipeline.files.lut_schema import (
    DATASETS,
    FILE_TEXTS,
    FIXED_SIZES,
    FORMAT,
    MINOR,
    SCALES,
    SMOOTHING_TEXTS,
    VERSION,
    DatasetSpec,
    arrays_of,
    content_of,
    links,
    root_attributes,
    smoothing_attributes,
    text_checksum,
    value_names,
)

Array = NDArray[Any]

#: HDF5 1.10 structures: checksummed, and readable by every library since 2016.
_FILE_VERSION = ("v110", "v110")
_STORAGE = {"compression": "gzip", "compression_opts": 6, "shuffle": True, "fletcher32": True}

#: The file and each of its arrays; a table of 100,000 entries with two bodies of 500,000 triangles stays well below.
MAX_BYTES = 256 * 2**20
#: Above this size an array must not be smaller on disk than 1/1000 of itself: deflate reaches 1/1032 at best.
_SMALL_BYTES = 2**20
_MAX_RATIO = 1000
_MAX_TEXT = 500
#: Name of the checksum of the texts; a table by another program may lack it.
_SEAL = "text_crc32"

#: Largest difference of a stored motion from the formula of its coordinates: rounding at a metre from the origin.
_FORMULA_TOLERANCE = 1e-6

#: CF spelling of the units that UDUNITS does not know.
_CF_UNITS = {"deg": "degree", "mixed": "1"}


def encode_lut(content: LutFileContent) -> bytes:
    """Bytes of ``lut.h5``, version 1.1.

    Raises
    ------
    ValueError
        When the content breaks the laws of :func:`pipeline.files.lut_content.check_content`, or an array has the
        wrong type.
    """
    import h5py  # noqa: PLC0415 - a cached run must not pay for it

    check_content(content)
    arrays = arrays_of(content)
    buffer = io.BytesIO()
    with h5py.File(buffer, "w", libver=_FILE_VERSION) as file:
        for spec in sorted(DATASETS, key=lambda spec: not spec.is_scale):
            _write_dataset(file, spec, arrays[spec.path])
        for place, target in links(MINOR).items():
            file[place] = file[target]
        texts, fits = root_attributes(content), smoothing_attributes(content)
        _write_texts(file, texts)
        _write_texts(file["/smoothing"], fits)
        file.attrs[_SEAL] = np.uint32(text_checksum(texts | fits))
        for path, names in value_names(content).items():
            _write_flags(file[path], names)
    return buffer.getvalue()


def _write_dataset(file: Any, spec: DatasetSpec, array: Array) -> None:
    if array.dtype != np.dtype(spec.dtype):
        raise ValueError(f"{spec.path}: expected {np.dtype(spec.dtype)}, got {array.dtype}")
    # HDF5 has no chunk of nothing; an empty array (midpoints of a single flexion) is written plain
    storage = {**_STORAGE, "chunks": array.shape} if array.size else {}
    dataset = file.create_dataset(spec.path, data=array, fillvalue=spec.fill, track_times=False, **storage)
    _write_texts(
        dataset,
        {
            "unit": spec.unit,
            "units": _CF_UNITS.get(spec.unit, spec.unit),
            "long_name": spec.title,
            "description": f"{spec.title}: {spec.meaning}",
        },
    )
    if spec.is_scale:
        dataset.make_scale(spec.dims[0])
        return
    for axis, dim in enumerate(spec.dims):
        dataset.dims[axis].attach_scale(file[SCALES[dim]])


def _write_texts(target: Any, texts: Mapping[str, str]) -> None:
    for name, text in sorted(texts.items()):
        target.attrs[name] = text


def _write_flags(dataset: Any, names: tuple[str, ...]) -> None:
    """Names of the values, for people and for CF readers; nothing for a table without fits."""
    if names:
        dataset.attrs["flags"] = list(names)
        dataset.attrs["flag_values"] = np.arange(len(names), dtype=dataset.dtype)
        dataset.attrs["flag_meanings"] = " ".join(names)


def decode_lut(data: bytes) -> LutFileContent:
    """The content of ``lut.h5`` bytes, of any origin.

    Raises
    ------
    ValueError
        For bytes that are not such a file, are damaged, have a newer major version, link or reach out of the file,
        or hold a table that :func:`pipeline.files.lut_content.check_content` refuses.
    """
    import h5py  # noqa: PLC0415 - a cached run must not pay for it

    if len(data) > MAX_BYTES:
        raise ValueError(f"the table is larger than {MAX_BYTES // 2**20} MiB")
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            _check_version(file)
            arrays = _read_arrays(file)
            texts = _read_texts(file)
    except (OSError, KeyError, RuntimeError, TypeError) as error:
        raise ValueError(f"not a readable table, or a damaged one: {error}") from error
    content = content_of(arrays, texts)
    check_content(content)
    _check_derived(arrays, arrays_of(content))
    return content


def _check_version(file: Any) -> None:
    if _text(file, "format") != FORMAT:
        raise ValueError(f"not a table of {FORMAT}")
    version = re.fullmatch(r"([0-9]{1,4})\.([0-9]{1,4})", _text(file, "version"))
    if version is None or version[1] != VERSION.partition(".")[0]:
        raise ValueError(
            f"the table has format version {_text(file, 'version')}, this program reads version "
            f"{VERSION.partition('.')[0]}; use the program that made it, or a newer one"
        )


def _text(target: Any, name: str) -> str:
    """A text attribute, checked."""
    text = target.attrs.get(name)
    if not isinstance(text, str) or len(text) > _MAX_TEXT or not text.isprintable():
        raise ValueError(f"{target.name}: expected a short text attribute {name}")
    return text


def _read_texts(file: Any) -> dict[str, str]:
    texts = {name: _text(file, name) for name in FILE_TEXTS}
    texts |= {name: _text(file["/smoothing"], name) for name in SMOOTHING_TEXTS}
    if file.attrs.get(_SEAL, text_checksum(texts)) != text_checksum(texts):
        raise ValueError(f"damaged: the texts do not have the checksum {_SEAL}")
    return texts


def _read_arrays(file: Any) -> dict[str, Array]:
    minor = min(_minor(file), MINOR)
    known = [spec for spec in DATASETS if spec.since <= minor]
    _check_links(file, "/", _members([*(spec.path for spec in known), *links(minor)]))
    sizes = dict(FIXED_SIZES)
    for spec in known:
        _check_dataset(file[spec.path], spec, sizes)
    _check_intervals(sizes)
    return {spec.path: file[spec.path][()] for spec in known}


def _minor(file: Any) -> int:
    return int(_text(file, "version").partition(".")[2])


def _members(paths: Iterable[str]) -> dict[str, set[str]]:
    """Names of the members of every group on the way to some paths."""
    members: dict[str, set[str]] = {}
    for full in paths:
        path = full
        while path != "/":
            group, _, name = path.rpartition("/")
            members.setdefault(group or "/", set()).add(name)
            path = group or "/"
    return members


def _check_links(group: Any, path: str, members: Mapping[str, set[str]]) -> None:
    """Every member known and linked hard; checked before it is opened, from the root down."""
    import h5py  # noqa: PLC0415 - see encode_lut

    # names of a later minor version are not opened, so they need not be known
    if unknown := sorted(set(group) - members[path]) if _minor(group.file) <= MINOR else []:
        raise ValueError(f"{path}: unknown member {unknown[0]!r}")
    for name in sorted(members[path]):
        full = f"{path.rstrip('/')}/{name}"
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise ValueError(f"{full}: expected a member of this file, found nothing or a link")
        member, is_group = group[name], full in members
        if not isinstance(member, h5py.Group if is_group else h5py.Dataset):
            raise ValueError(f"{full}: expected a {'group' if is_group else 'dataset'}")
        if is_group:
            _check_links(member, full, members)


def _check_dataset(dataset: Any, spec: DatasetSpec, sizes: dict[str, int]) -> None:
    """Type, dimensions and storage of one dataset, before it is read; learns the sizes of its dimensions."""
    if dataset.dtype != np.dtype(spec.dtype):
        raise ValueError(f"{spec.path}: expected {np.dtype(spec.dtype)}, got {dataset.dtype}")
    if len(dataset.shape) != len(spec.dims):
        raise ValueError(f"{spec.path}: expected {len(spec.dims)} dimensions, got {len(dataset.shape)}")
    for dim, size in zip(spec.dims, dataset.shape, strict=True):
        if sizes.setdefault(dim, size) != size:
            raise ValueError(f"{spec.path}: expected {sizes[dim]} values along {dim}, got {size}")
    if dataset.external or dataset.is_virtual or not set(_filters(dataset)) <= _own_filters():
        raise ValueError(f"{spec.path}: stored outside the file, or by an unknown filter")
    size, stored = dataset.size * dataset.dtype.itemsize, dataset.id.get_storage_size()
    if size > MAX_BYTES or (size > _SMALL_BYTES and size > _MAX_RATIO * stored):
        raise ValueError(f"{spec.path}: declares {size} bytes and stores {stored}")
    if size and not stored:
        raise ValueError(f"{spec.path}: was declared and never written")


def _filters(dataset: Any) -> Iterator[int]:
    plist = dataset.id.get_create_plist()
    return (plist.get_filter(index)[0] for index in range(plist.get_nfilters()))


def _own_filters() -> set[int]:
    import h5py  # noqa: PLC0415 - see encode_lut

    return {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}


def _check_intervals(sizes: Mapping[str, int]) -> None:
    if sizes["flexion_midpoint_deg"] != sizes["flexion_deg"] - 1:
        raise ValueError(f"/smoothing/midpoint_error_mm: expected {sizes['flexion_deg'] - 1} flexion intervals")


def _check_derived(stored: Mapping[str, Array], computed: Mapping[str, Array]) -> None:
    """The motions and the scales are what follows from the rest."""
    for path in ("/lut/moved_from_scan", "/raw/moved_from_scan"):
        if not np.allclose(stored[path], computed[path], rtol=0.0, atol=_FORMULA_TOLERANCE, equal_nan=True):
            raise ValueError(f"{path}: does not follow from the coordinates and the frames")
    for path in SCALES.values():
        if path in stored and not np.array_equal(stored[path], computed[path]):
            raise ValueError(f"{path}: does not number the values along {path.rpartition('/')[2]}")
