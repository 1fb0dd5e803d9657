"""``lut.h5`` version 1 as data: every dataset with its type, dimensions, unit and meaning, and whence its values.

The writer and the reader in :mod:`pipeline.files.lut_file` both walk :data:`DATASETS`; ``docs/lut-format.md`` is the
same list for people, and a test holds the two together.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.files.lut_content import LutFileContent
from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.interpolation import moved_from_scan_table
from pipeline.kinematics.neutral import NeutralCurve
from pipeline.kinematics.table import CurveFit, Grid, LutTable, PoseTable, RawTable, SmoothTable

Array = NDArray[Any]

FORMAT = "ct2lut"
#: 1.1 gave every dimension a scale; a reader of 1.0 passes over what it does not know.
MINOR = 1
VERSION = f"1.{MINOR}"
BASIS = "chebyshev"

#: Names of the status values, in order of the values.
FLAGS = ("ok", "smoothed", "slid_off", "rotation_bound", "no_contact", "not_converged")

#: Dimensions that are the same in every table.
FIXED_SIZES = {"row": 4, "column": 4, "xyz": 3, "corner": 3, "end": 2, "coordinate": 6, "driven": 2}

#: Names of the driven coordinates, of the ends of a range, and of the coordinates of the scan pose, in their order.
_DRIVEN = ("flexion_deg", "varus_deg")
_SCAN_POSE = (*_DRIVEN, "internal_rotation_deg", "lateral_mm", "anterior_mm", "proximal_mm")

#: Attributes of the file and of ``/smoothing`` that are read back.
FILE_TEXTS = ("joint", "side", "software")
SMOOTHING_TEXTS = ("basis", "curves", "curve_units")
SEALED_TEXTS = (*FILE_TEXTS, *SMOOTHING_TEXTS)


@dataclass(frozen=True)
class DatasetSpec:
    """One dataset: absolute path, numpy type, names of its dimensions, unit, names; the minor version it came with."""

    path: str
    dtype: str
    dims: tuple[str, ...]
    unit: str
    title: str
    meaning: str
    since: int

    @property
    def group(self) -> str:
        """The group it lies in."""
        return self.path.rpartition("/")[0] or "/"

    @property
    def is_scale(self) -> bool:
        """Whether it is the scale of its one dimension: the named coordinate of CF readers."""
        return self.dims == (self.path.rpartition("/")[2],)

    @property
    def fill(self) -> float | int:
        """Value that stands for *not computed*; never one that could be taken for a result."""
        return {"f8": np.nan, "i4": -1, "u1": 255}[self.dtype]


#: Path, numpy type, dimensions, unit, title: meaning. A path that begins with * stands for one in /lut and one in /raw.
_LAYOUT = """
/grid/flexion_deg            f8 flexion_deg           deg flexion: flexion +, strictly increasing
/grid/varus_deg              f8 varus_deg             deg varus: varus +, strictly increasing
/row                         i4 row                   1   matrix row: row of a 4x4 matrix
/column                      i4 column                1   matrix column: column of a 4x4 matrix
*/lateral_mm                 f8 flexion_deg,varus_deg mm  lateral position: x of the moving origin, attitude frame
*/anterior_mm                f8 flexion_deg,varus_deg mm  anterior position: y of the moving origin, attitude frame
*/proximal_mm                f8 flexion_deg,varus_deg mm  proximal position: z (along delta) of the moving origin
*/internal_rotation_deg      f8 flexion_deg,varus_deg deg internal rotation: of the moving body about delta, internal +
*/status                     u1 flexion_deg,varus_deg 1   status: what became of the entry; usable where 0 or 1
*/equilibrium_residual       f8 flexion_deg,varus_deg 1   equilibrium residual: 0 is perfect equilibrium, 1 is none
*/medial_gap_mm              f8 flexion_deg,varus_deg mm  medial gap: smallest distance in the medial compartment
*/lateral_gap_mm             f8 flexion_deg,varus_deg mm  lateral gap: smallest distance in the lateral compartment
*/contact_count              i4 flexion_deg,varus_deg 1   contact count: contacts within the contact band
*/moved_from_scan            f8 flexion_deg,varus_deg,row,column mm  motion: from the scan to its place
/raw/iterations              i4 flexion_deg,varus_deg 1   iterations: motions the solver made
/raw/gap_before_mm           f8 flexion_deg,varus_deg mm  gap before contact: pulled back by this, the bodies are clear
/raw/gap_after_mm            f8 flexion_deg,varus_deg mm  gap after contact: pushed on by this, the bodies intersect
/raw/hysteresis_mm           f8 flexion_deg,varus_deg mm  hysteresis of position: way out against way back
/raw/hysteresis_deg          f8 flexion_deg,varus_deg deg hysteresis of rotation: way out against way back
/raw/margin_lateral_mm       f8 flexion_deg,varus_deg mm  lateral margin: a push within which the depth keeps falling
/raw/margin_anterior_mm      f8 flexion_deg,varus_deg mm  anterior margin: a push within which the depth keeps falling
/raw/margin_rotation_deg     f8 flexion_deg,varus_deg deg rotation margin: a turn within which the depth keeps falling
/neutral/varus_deg           f8 flexion_deg           deg neutral varus: at which both compartments touch
/neutral/lateral_mm          f8 flexion_deg           mm  lateral position: at neutral varus
/neutral/anterior_mm         f8 flexion_deg           mm  anterior position: at neutral varus
/neutral/proximal_mm         f8 flexion_deg           mm  proximal position: at neutral varus
/neutral/internal_rotation_deg f8 flexion_deg         deg internal rotation: at neutral varus
/neutral/uneven_mm           f8 flexion_deg           mm  unevenness: lateral minus medial clearance along delta
/neutral/status              u1 flexion_deg           1   status: usable where 0
/smoothing/coefficients      f8 curve,flexion_order,varus_order 1   coefficients: in the curve's unit
/smoothing/degrees           i4 curve,driven          1   degrees: of each curve in flexion and in varus
/smoothing/residual_rms      f8 curve                 1   RMS residual: of raw minus fitted, in the curve's unit
/smoothing/residual_max      f8 curve                 1   largest residual: of raw minus fitted, in the curve's unit
/smoothing/flexion_range_deg f8 end                   deg flexion range: ends that the basis scales to -1 and 1
/smoothing/varus_range_deg   f8 end                   deg varus range: ends that the basis scales to -1 and 1
/smoothing/contact_error_mm  f8 flexion_deg,varus_deg mm  contact error: signed way to contact, gap + (along delta)
/smoothing/midpoint_error_mm f8 flexion_midpoint_deg,varus_deg mm  midpoint error: the same half-way in flexion
/frames/scan_from_reference  f8 row,column            mm  reference frame: x lateral, y anterior, z proximal
/frames/scan_from_moving     f8 row,column            mm  moving frame: x lateral, y anterior, z delta
/frames/delta                f8 xyz                   1   delta: direction of the push, scan space, at the scan pose
/frames/scan_attitude        f8 coordinate            mixed scan pose: flexion, varus, rotation (deg), x, y, z (mm)
/bodies/reference/points     f8 reference_point,xyz   mm  vertices: of the reference body, scan space
/bodies/reference/triangles  i4 reference_triangle,corner 1   triangles: vertex indices, outward normals
/bodies/moving/points        f8 moving_point,xyz      mm  vertices: of the moving body, scan space, as scanned
/bodies/moving/triangles     i4 moving_triangle,corner 1   triangles: vertex indices, outward normals
"""
#: What 1.1 added, all of it scales.
_LAYOUT_1 = """
/xyz                         i4 xyz                   1   axis of scan space: to the left, posterior, superior
/corner                      i4 corner                1   corner: of a triangle
/smoothing/curve             i4 curve                 1   curve: found coordinate that was smoothed
/smoothing/driven            i4 driven                1   driven coordinate: flexion, varus
/smoothing/end               i4 end                   1   end of a range: first, last
/smoothing/flexion_order     i4 flexion_order         1   order in flexion: p of T_p
/smoothing/varus_order       i4 varus_order           1   order in varus: q of T_q
/smoothing/flexion_midpoint_deg f8 flexion_midpoint_deg deg flexion half-way: between two flexions of the grid
/frames/coordinate           i4 coordinate            1   coordinate: of the scan pose
/bodies/reference/reference_point i4 reference_point  1   vertex: index that the triangles use
/bodies/reference/reference_triangle i4 reference_triangle 1 triangle: index
/bodies/moving/moving_point  i4 moving_point          1   vertex: index that the triangles use
/bodies/moving/moving_triangle i4 moving_triangle     1   triangle: index
"""

#: Fields of RawTable that are arrays of their own.
_RAW_ONLY = tuple(field.name for field in fields(RawTable) if field.name not in ("grid", "poses"))
#: Fields of NeutralCurve; its flexion is that of the grid.
_NEUTRAL = tuple(field.name for field in fields(NeutralCurve) if field.name != "flexion_deg")


def _specs(line: str, since: int) -> Iterator[DatasetSpec]:
    path, dtype, dims, unit, text = line.split(maxsplit=4)
    title, _, meaning = text.partition(": ")
    for full in (path.replace("*", "/lut"), path.replace("*", "/raw")) if path.startswith("*") else (path,):
        yield DatasetSpec(full, dtype, tuple(dims.split(",")), unit, title, meaning, since)


#: Every dataset of version 1.
DATASETS: tuple[DatasetSpec, ...] = tuple(
    spec
    for since, layout in enumerate((_LAYOUT, _LAYOUT_1))
    for line in layout.strip().splitlines()
    for spec in _specs(line, since)
)
#: Every dimension and the path of its scale.
SCALES = {spec.dims[0]: spec.path for spec in DATASETS if spec.is_scale}

#: Groups that held a link to each grid axis in 1.0.
_GRID_LINKED_IN = ("/", "/lut", "/raw", "/smoothing")


def links(minor: int) -> dict[str, str]:
    """Hard links, path -> path it leads to, so that each group has the coordinates of its data in itself.

    Neutral varus has a second name: where groups are read as a tree, the grid's varus hides the first.
    """
    linked = [(group, axis) for group in _GRID_LINKED_IN for axis in _DRIVEN]
    if minor >= 1:
        linked += [(spec.group, dim) for spec in DATASETS for dim in spec.dims]
    places = {f"{group.rstrip('/')}/{dim}": SCALES[dim] for group, dim in linked}
    second = {"/neutral/neutral_varus_deg": "/neutral/varus_deg"} if minor >= 1 else {}
    return second | {place: scale for place, scale in places.items() if place != scale}


def root_attributes(content: LutFileContent) -> dict[str, str]:
    """Text attributes of the file itself."""
    return {
        "Conventions": "CF-1.11",
        "angle_unit": "deg",
        "format": FORMAT,
        "joint": content.joint,
        "length_unit": "mm",
        "notice": "Research use - not for diagnosis",
        "side": content.side,
        "software": content.software,
        "space": "LPS (DICOM patient space), millimetres; 4x4 matrices act on column vectors",
        "title": "Look-up table of the stable poses of a joint",
        "version": VERSION,
    }


def smoothing_attributes(content: LutFileContent) -> dict[str, str]:
    """Text attributes of ``/smoothing``: the basis, and name and unit of each curve, separated by blanks."""
    return {
        "basis": BASIS,
        "curves": " ".join(fit.name for fit in content.smooth.fits),
        "curve_units": " ".join(fit.unit for fit in content.smooth.fits),
    }


def value_names(content: LutFileContent) -> dict[str, tuple[str, ...]]:
    """Names of the values 0, 1, 2 ... of the datasets that number things, by path."""
    return {
        **{f"/{group}/status": FLAGS for group in ("lut", "raw", "neutral")},
        "/xyz": ("x", "y", "z"),
        "/frames/coordinate": _SCAN_POSE,
        "/smoothing/curve": tuple(fit.name for fit in content.smooth.fits),
        "/smoothing/driven": _DRIVEN,
        "/smoothing/end": ("first", "last"),
    }


def text_checksum(texts: Mapping[str, str]) -> int:
    """CRC-32 of :data:`SEALED_TEXTS`: HDF5 keeps texts where it has no checksum of its own."""
    return zlib.crc32("\n".join(f"{name}={texts[name]}" for name in SEALED_TEXTS).encode())


def arrays_of(content: LutFileContent) -> dict[str, Array]:
    """Array of every dataset by its path."""
    smooth, raw = content.smooth, content.raw
    arrays: dict[str, Array] = {
        "/grid/flexion_deg": smooth.grid.flexion_deg,
        "/grid/varus_deg": smooth.grid.varus_deg,
        "/smoothing/contact_error_mm": smooth.contact_error_mm,
        "/smoothing/midpoint_error_mm": smooth.midpoint_error_mm,
        "/frames/scan_from_reference": content.scan_from_reference,
        "/frames/scan_from_moving": content.scan_from_moving,
        "/frames/delta": content.delta,
        "/frames/scan_attitude": content.scan_attitude,
    }
    for group, poses in (("lut", smooth.poses), ("raw", raw.poses)):
        arrays |= {f"/{group}/{field.name}": getattr(poses, field.name) for field in fields(PoseTable)}
        table = LutTable(content.side, smooth.grid, poses, content.scan_from_reference, content.scan_from_moving)
        arrays[f"/{group}/moved_from_scan"] = moved_from_scan_table(table)
    arrays |= {f"/raw/{name}": getattr(raw, name) for name in _RAW_ONLY}
    arrays |= {f"/neutral/{name}": getattr(content.neutral, name) for name in _NEUTRAL}
    for name, body in (("reference", content.reference_body), ("moving", content.moving_body)):
        arrays |= {f"/bodies/{name}/points": body.points, f"/bodies/{name}/triangles": body.triangles}
    arrays |= _fit_arrays(smooth)
    return arrays | _scale_arrays(arrays)


def _scale_arrays(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Values of the scales: half-way between the flexions of the grid, and plain indices."""
    sizes = {
        dim: size
        for spec in DATASETS
        if spec.path in arrays
        for dim, size in zip(spec.dims, arrays[spec.path].shape, strict=True)
    }
    indices = {path: np.arange(sizes[dim], dtype=np.int32) for dim, path in SCALES.items() if path not in arrays}
    flexion = arrays["/grid/flexion_deg"]
    return indices | {SCALES["flexion_midpoint_deg"]: (flexion[:-1] + flexion[1:]) / 2.0}


def _fit_arrays(smooth: SmoothTable) -> dict[str, Array]:
    """The fits as stacked arrays; a coefficient of 0 beyond a curve's own degrees changes nothing."""
    degrees = np.array([fit.coefficients.shape for fit in smooth.fits], dtype=np.int32).reshape(-1, 2) - np.int32(1)
    stacked = np.zeros((len(smooth.fits), *(degrees.max(axis=0, initial=-1) + 1)))
    for index, fit in enumerate(smooth.fits):
        stacked[index, : fit.coefficients.shape[0], : fit.coefficients.shape[1]] = fit.coefficients
    return {
        "/smoothing/coefficients": stacked,
        "/smoothing/degrees": degrees,
        "/smoothing/residual_rms": np.array([fit.residual_rms for fit in smooth.fits], dtype=np.float64),
        "/smoothing/residual_max": np.array([fit.residual_max for fit in smooth.fits], dtype=np.float64),
        "/smoothing/flexion_range_deg": smooth.flexion_range_deg,
        "/smoothing/varus_range_deg": smooth.varus_range_deg,
    }


def content_of(arrays: Mapping[str, Array], attributes: Mapping[str, str]) -> LutFileContent:
    """The inverse of :func:`arrays_of`, :func:`root_attributes` and :func:`smoothing_attributes` taken together.

    Parameters
    ----------
    arrays : mapping
        Path -> array of the type and dimensions of :data:`DATASETS`.
    attributes : mapping
        :data:`SEALED_TEXTS`.

    Raises
    ------
    ValueError
        When the curve names do not fit the coefficients.
    """
    grid = Grid(arrays["/grid/flexion_deg"], arrays["/grid/varus_deg"])
    smooth = SmoothTable(
        grid,
        _poses_of(arrays, "lut"),
        _fits_of(arrays, attributes),
        arrays["/smoothing/flexion_range_deg"],
        arrays["/smoothing/varus_range_deg"],
        arrays["/smoothing/contact_error_mm"],
        arrays["/smoothing/midpoint_error_mm"],
    )
    return LutFileContent(
        joint=attributes["joint"],
        side=attributes["side"],
        software=attributes["software"],
        smooth=smooth,
        raw=RawTable(grid, _poses_of(arrays, "raw"), **{name: arrays[f"/raw/{name}"] for name in _RAW_ONLY}),
        neutral=NeutralCurve(grid.flexion_deg, **{name: arrays[f"/neutral/{name}"] for name in _NEUTRAL}),
        **{
            name: arrays[f"/frames/{name}"]
            for name in ("scan_from_reference", "scan_from_moving", "delta", "scan_attitude")
        },
        reference_body=_body_of(arrays, "reference"),
        moving_body=_body_of(arrays, "moving"),
    )


def _poses_of(arrays: Mapping[str, Array], group: str) -> PoseTable:
    return PoseTable(**{field.name: arrays[f"/{group}/{field.name}"] for field in fields(PoseTable)})


def _body_of(arrays: Mapping[str, Array], body: str) -> TriangleMesh:
    return TriangleMesh(arrays[f"/bodies/{body}/points"], arrays[f"/bodies/{body}/triangles"])


def _fits_of(arrays: Mapping[str, Array], attributes: Mapping[str, str]) -> tuple[CurveFit, ...]:
    names, units = attributes["curves"].split(), attributes["curve_units"].split()
    sizes = arrays["/smoothing/degrees"] + 1
    if attributes["basis"] != BASIS or not len(names) == len(units) == len(sizes):
        raise ValueError(f"/smoothing: expected basis {BASIS} and one name and unit for each of {len(sizes)} curves")
    return tuple(
        CurveFit(name, unit, coefficients[:rows, :columns], float(rms), float(worst))
        for name, unit, (rows, columns), coefficients, rms, worst in zip(
            names,
            units,
            sizes,
            arrays["/smoothing/coefficients"],
            arrays["/smoothing/residual_rms"],
            arrays["/smoothing/residual_max"],
            strict=True,
        )
    )
