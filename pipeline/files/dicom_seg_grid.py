"""Where the frames of a DICOM SEG lie: from each frame's own header to one even grid, or a refusal.

Format: DICOM PS3.3 C.7.6.16.2 (functional groups of pixel measures, plane position and plane orientation). Planes
without a label may be left out of a file, so a gap is a whole number of steps and not a missing plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import CaseRejected
from pipeline.files.dicom_headers import DicomFile, DicomHeader
from pipeline.files.dicom_stack import LANDING_MM, SAME_PLACE_MM, in_plane
from pipeline.files.dicom_tags import Tags
from pipeline.files.foreign_image import bad_header, no_orientation
from pipeline.geometry.volume import corner_points

Float = NDArray[np.float64]

#: Positions beyond this are no place on a table.
_FAR_MM = 1e5
#: How far directions may be from one another, and from right angles.
_SAME_DIRECTION = 1e-4
_AGAIN = "Export the segmentation again with the geometry of the CT it was drawn on, all frames upright and even."
#: Functional group, its tag, how many numbers that has.
_MACROS = (
    ("PlanePositionSequence", "ImagePositionPatient", 3),
    ("PlaneOrientationSequence", "ImageOrientationPatient", 6),
    ("PixelMeasuresSequence", "PixelSpacing", 2),
)


@dataclass(frozen=True, eq=False)
class Places:
    """Where each frame says it lies.

    Attributes
    ----------
    positions, orientations, spacings : (F, 3), (F, 6), (F, 2) float64
        ImagePositionPatient (mm, LPS), ImageOrientationPatient, PixelSpacing (mm; between rows, between columns).
    step_mm : float or None
        SpacingBetweenSlices, where the file has it.
    """

    positions: Float
    orientations: Float
    spacings: Float
    step_mm: float | None


@dataclass(frozen=True, eq=False)
class Grid:
    """The grid that the frames are on.

    Attributes
    ----------
    lps_from_index : (4, 4) float64
        Index: column, row, plane. Right-handed.
    planes : (F,) int64
        Which plane each frame is.
    """

    lps_from_index: Float
    planes: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Planes from the first to the last, those without a frame among them."""
        return int(self.planes.max()) + 1


def functional_groups(opened: DicomFile, file: str) -> tuple[tuple[Tags, Tags], ...]:
    """The functional groups of each frame: its own, and those of all frames.

    Raises
    ------
    CaseRejected
        E-IO-13 where they are not as many as the frames.
    """
    own = opened.tags.items("PerFrameFunctionalGroupsSequence")
    if len(own) != opened.header.frames:
        raise bad_header(file, f"it declares {opened.header.frames} frames and describes {len(own)}")
    shared = (*opened.tags.items("SharedFunctionalGroupsSequence"), Tags({}))[0]
    return tuple((one, shared) for one in own)


def group_item(groups: tuple[Tags, Tags], sequence: str) -> Tags | None:
    """The one item of a functional group of a frame; None where it is neither the frame's own nor shared."""
    for group in groups:
        if items := group.items(sequence):
            return items[0] if len(items) == 1 else None
    return None


def read_places(frames: tuple[tuple[Tags, Tags], ...], file: str) -> Places:
    """Where each frame says it lies.

    Raises
    ------
    CaseRejected
        E-GEO-01 where a frame does not, E-IO-13 for what is no number, E-GEO-02 for two distances between planes.
    """
    numbers: list[list[tuple[float, ...]]] = [[], [], []]
    steps: set[float] = set()
    for frame, groups in enumerate(frames, start=1):
        for column, (sequence, keyword, count) in zip(numbers, _MACROS, strict=True):
            item = group_item(groups, sequence)
            found = None if item is None else item.decimals(keyword, count)
            if item is None or found is None:
                raise _no_place(file, frame, keyword, item)
            column.append(found)
            steps |= _declared_steps(item, file) if keyword == "PixelSpacing" else set()
    if len(steps) > 1:
        raise _two_steps(file, min(steps), max(steps))
    positions, orientations, spacings = (np.array(column, dtype=np.float64) for column in numbers)
    return Places(positions, orientations, spacings, *steps or (None,))


def _declared_steps(measures: Tags, file: str) -> set[float]:
    step = measures.decimal("SpacingBetweenSlices")
    if fault := measures.faults.get("SpacingBetweenSlices"):
        raise bad_header(file, f"SpacingBetweenSlices {fault}")
    return set() if step is None else {abs(step)}


def grid_of(places: Places, header: DicomHeader, file: str) -> Grid:
    """The even grid that holds every frame where the frame's own header says, within LANDING_MM.

    Raises
    ------
    CaseRejected
        E-IO-13, E-DCM-08, E-DCM-11, E-DCM-13, E-DCM-16, E-LBL-04 (one plane only), E-GEO-02.
    """
    _check_meaning(places, file)
    _check_alike(places, file)
    orientation, spacing = places.orientations[0], places.spacings[0]
    across, down = in_plane(replace(header, orientation=tuple(orientation)))
    normal = np.cross(across, down)
    heights = places.positions @ normal
    order = np.argsort(heights, kind="stable")
    first, last = places.positions[order[0]], places.positions[order[-1]]
    planes = np.empty(len(order), dtype=np.int64)
    planes[order] = _plane_numbers(heights[order], places.step_mm, file)
    along = normal * (heights[order[-1]] - heights[order[0]])
    if np.linalg.norm(last - first - along) > LANDING_MM / 2:  # a lean, which the gate of volumes judges
        along = last - first
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([across * spacing[1], down * spacing[0], along / planes.max(), first])
    grid = Grid(matrix, planes)
    _check_landing(grid, places, (header.columns or 0, header.rows or 0), file)
    return grid


def _check_meaning(places: Places, file: str) -> None:
    """Numbers that can be places, lengths and directions."""
    if np.abs(places.positions).max() > _FAR_MM:
        raise bad_header(file, "ImagePositionPatient is beyond 100 m")
    if not (places.spacings.min() > 0 and places.spacings.max() < 1e3):
        raise bad_header(file, "PixelSpacing is not a length")
    row, column = places.orientations[:, :3], places.orientations[:, 3:]
    lengths = np.linalg.norm([row, column], axis=2)
    off = max(np.abs(lengths - 1.0).max(), np.abs((row * column).sum(axis=1)).max())
    if not off <= _SAME_DIRECTION:
        problem = f"ImageOrientationPatient of {file} is not two directions at right angles."
        raise CaseRejected("E-DCM-08", problem, _AGAIN)


def _check_alike(places: Places, file: str) -> None:
    """Every frame looks the same way with the same pixels."""
    for keyword, found, limit in (
        ("ImageOrientationPatient", places.orientations, _SAME_DIRECTION),
        ("PixelSpacing", places.spacings, 1e-5),
    ):
        off = np.abs(found - found[0]).max(axis=1)
        if off.max() > limit:
            problem = f"{keyword} of frame {int(np.argmax(off)) + 1} of {file} is not that of frame 1."
            raise CaseRejected("E-DCM-13", problem, _AGAIN)


def _plane_numbers(heights: Float, declared_mm: float | None, file: str) -> NDArray[np.int64]:
    """(F,) the plane of each of the heights, which rise.

    The step is the usual gap, not the smallest: else one frame out of place could make a finer grid that fits it.
    """
    gaps = np.diff(heights)
    wide = gaps[gaps >= SAME_PLACE_MM]
    if not len(wide):
        raise CaseRejected(
            "E-LBL-04", f"All frames of {file} lie in one plane, expected one 3-D label map.", "Export all its planes."
        )
    usual = np.sort(wide)[(len(wide) - 1) // 2]
    planes = np.concatenate([[0], np.cumsum(np.rint(np.where(gaps < SAME_PLACE_MM, 0.0, gaps) / usual))])
    step = (heights[-1] - heights[0]) / planes[-1]
    off = np.abs(heights - heights[0] - planes * step)
    if off.max() > LANDING_MM:
        raise CaseRejected(
            "E-DCM-11",
            f"The planes of {file} are not evenly spaced: gaps from {wide.min():.4g} to {wide.max():.4g} mm, expected "
            f"whole numbers of steps within {LANDING_MM} mm.",
            _AGAIN,
        )
    if declared_mm is not None and abs(declared_mm - step) > LANDING_MM:
        raise _two_steps(file, declared_mm, float(step))
    return planes.astype(np.int64)


def _check_landing(grid: Grid, places: Places, size: tuple[int, int], file: str) -> None:
    """The promise of this module, frame by frame: its corners are where its own header says."""
    corners = corner_points(np.eye(4), (*size, 1))[::2]  # (column, row, 0), every second one, for there is one plane
    row, column = places.orientations[:, None, :3], places.orientations[:, None, 3:]
    own = places.positions[:, None] + row * (corners[:, :1] * places.spacings[:, None, 1:])
    own = own + column * (corners[:, 1:2] * places.spacings[:, None, :1])
    index = np.broadcast_to(corners, (len(own), *corners.shape)).copy()
    index[:, :, 2] = grid.planes[:, None]
    off = np.linalg.norm(index @ grid.lps_from_index[:3, :3].T + grid.lps_from_index[:3, 3] - own, axis=2).max(axis=1)
    if not off.max() <= LANDING_MM:
        frame = int(np.argmax(off)) + 1
        problem = (
            f"Frame {frame} of {file} would lie {off.max():.3g} mm off its own header, "
            f"expected at most {LANDING_MM} mm."
        )
        raise CaseRejected("E-DCM-16", problem, _AGAIN)


def _no_place(file: str, frame: int, keyword: str, item: Tags | None) -> CaseRejected:
    fault = "" if item is None else item.faults.get(keyword, "")
    if fault:
        return bad_header(file, f"{keyword} of frame {frame} {fault}")
    return no_orientation(file, f"frame {frame} has no {keyword} of its own")


def _two_steps(file: str, one_mm: float, other_mm: float) -> CaseRejected:
    return CaseRejected(
        "E-GEO-02",
        f"{file} gives two distances between its planes, {one_mm:.4g} and {other_mm:.4g} mm, expected one.",
        _AGAIN,
    )
