"""The geometry gate of a DICOM series: whether slices, each placed by its own header, are an even upright grid.

The distance between slices is that of their positions; thickness, spacing and tilt as declared are never used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.dicom_headers import DicomHeader
from pipeline.files.geometry_gate import check_geometry

Float = NDArray[np.float64]

#: How far slices may lie beside the line through the stack, mm, before it is a tilt.
TILT_MM = 0.05
#: How far from even a gap between slices may be: rejected beyond the larger of mm and fraction, noted above the last.
UNEVEN_MM, UNEVEN_FRACTION, EVEN_MM = 0.1, 0.05, 0.01
#: Where the slices at both ends may lie beside what their headers say.
LANDING_MM = 0.01
#: Slices nearer than this are at the same place; a deviation below the second is rounding.
SAME_PLACE_MM, ROUNDING_MM = 0.01, 0.001
#: A larger part of the gaps that are wide is another pitch, not missing slices.
HOLES_FRACTION = 0.25

_ORIGINAL = "Export the complete original axial series from the PACS again."


@dataclass(frozen=True, eq=False)
class Stack:
    """Slices in order along their normal, and the grid that they are.

    Attributes
    ----------
    slices : tuple of DicomHeader
    lps_from_index : (4, 4) float64
        Index: column, row, slice. Right-handed.
    findings : tuple of Finding
        Where the slices are a little uneven.
    """

    slices: tuple[DicomHeader, ...]
    lps_from_index: Float
    findings: tuple[Finding, ...]


def check_stack(slices: Sequence[DicomHeader]) -> Stack:
    """The grid of slices that :func:`choose_series` found alike.

    Raises
    ------
    CaseRejected
        E-DCM-09 missing slices, E-DCM-10 doubled, E-DCM-11 uneven, E-DCM-14 beside one another, E-GEO-*.
    """
    across, down = in_plane(slices[0])
    normal = np.cross(across, down)
    positions = np.array([header.position for header in slices])
    order = np.argsort(positions @ normal, kind="stable")
    ordered, positions = [slices[n] for n in order], positions[order]
    heights = (positions - positions[0]) @ normal
    _check_doubled(ordered, np.diff(heights))
    lateral = (positions - positions[0]) - np.outer(heights, normal)
    _check_lateral(ordered, heights, lateral)
    findings = _check_even(ordered, heights)
    step = normal * heights[-1]
    if np.linalg.norm(lateral[-1]) > LANDING_MM / 2:  # then the third axis leans, as far as the gate of volumes allows
        step = positions[-1] - positions[0]
    spacing = slices[0].pixel_spacing or (0.0, 0.0)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([across * spacing[1], down * spacing[0], step / (len(ordered) - 1), positions[0]])
    shape = (slices[0].columns or 0, slices[0].rows or 0, len(ordered))
    check_geometry(matrix, shape, "the CT series")
    return Stack(tuple(ordered), matrix, findings)


def in_plane(header: DicomHeader) -> tuple[Float, Float]:
    """Unit directions in which columns and rows are counted, at right angles to the last bit."""
    row, column = np.array(header.orientation, dtype=np.float64).reshape(2, 3)
    across = row / np.linalg.norm(row)
    down = column - (column @ across) * across
    return across, down / np.linalg.norm(down)


def _check_doubled(slices: Sequence[DicomHeader], gaps: Float) -> None:
    for one, other, gap in zip(slices[:-1], slices[1:], gaps, strict=True):
        if gap >= SAME_PLACE_MM:
            continue
        problem = f"{one.file} and {other.file} are two different slices at the same place, {_place(one)}."
        raise CaseRejected("E-DCM-10", problem, "Export one reconstruction of the scan only, and only once.")


def _check_lateral(slices: Sequence[DicomHeader], heights: Float, lateral: Float) -> None:
    """The slices lie above one another: no tilt of the gantry, no slice pushed sideways."""
    off = np.linalg.norm(lateral, axis=1)
    if off.max() <= TILT_MM:
        return
    # away from the middle of the stack, so that one slice out of place cannot pass for a tilt
    centred = heights - heights.mean()
    slope = centred @ (lateral - lateral.mean(axis=0)) / (centred @ centred)
    left = np.linalg.norm(lateral - lateral.mean(axis=0) - np.outer(centred, slope), axis=1)
    if left.max() > TILT_MM:
        worst = slices[int(np.argmax(left))]
        problem = (
            f"{worst.file} lies {left.max():.3g} mm beside the line of the other slices, expected at most {TILT_MM} mm."
        )
        raise CaseRejected("E-DCM-14", problem, _ORIGINAL)
    angle = float(np.degrees(np.arctan(np.linalg.norm(slope))))
    raise CaseRejected(
        "E-GEO-04",
        f"The slices of the CT series are tilted against their stack by {angle:.3g} deg ({off.max():.3g} mm over the "
        f"stack), expected at most {TILT_MM} mm.",
        "Scan without gantry tilt, or have the series reformatted to upright slices at the scanner.",
    )


def _check_even(slices: Sequence[DicomHeader], heights: Float) -> tuple[Finding, ...]:
    """Refuse gaps that differ, and slices that are not where an even grid has them."""
    gaps = np.diff(heights)
    usual = float(np.median(gaps))
    limit = max(UNEVEN_MM, UNEVEN_FRACTION * usual)
    _check_missing(slices, gaps, usual)
    even = np.linspace(0.0, heights[-1], len(heights))
    off = np.abs(heights - even)
    off[1:] = np.maximum(off[1:], np.abs(gaps - usual))
    worst, deviation = slices[int(np.argmax(off))], float(off.max())
    if deviation > limit:
        problem = (
            f"The slices of the CT series are not evenly spaced: {worst.file} at {_place(worst)} is {deviation:.3g} mm "
            f"out of place, expected at most {limit:.3g} mm (gaps from {gaps.min():.4g} to {gaps.max():.4g} mm)."
        )
        raise CaseRejected("E-DCM-11", problem, _ORIGINAL)
    if deviation <= ROUNDING_MM:
        return ()
    grid = f"an even spacing of {usual:.4g} mm"
    if deviation > EVEN_MM:
        uneven = f"{worst.file} lies {deviation:.2g} mm out of {grid}; even spacing was assumed for the CT series."
        return (Finding("W-DCM-02", Severity.REVIEW, uneven),)
    rounded = f"The slices of the CT series are up to {deviation:.2g} mm out of {grid}, as from rounding."
    return (Finding("N-DCM-04", Severity.NOTE, rounded),)


def _check_missing(slices: Sequence[DicomHeader], gaps: Float, usual: float) -> None:
    """Gaps of a whole number of steps among even ones are slices that were lost."""
    steps = np.rint(gaps / usual)
    whole = np.abs(gaps - steps * usual) <= np.maximum(UNEVEN_MM, UNEVEN_FRACTION * usual)
    holes = np.flatnonzero(steps >= 2)
    if not len(holes) or not whole.all() or len(holes) > max(1.0, HOLES_FRACTION * len(gaps)):
        return
    shown = "; ".join(
        f"{int(steps[n]) - 1} between {slices[n].file} at {_place(slices[n])} and {slices[n + 1].file} at "
        f"{_place(slices[n + 1])}"
        for n in holes[:5]
    )
    lost = int((steps[holes] - 1).sum())
    problem = f"{lost} slices are missing inside the CT series: {shown}."
    raise CaseRejected("E-DCM-09", problem, _ORIGINAL)


def _place(header: DicomHeader) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in header.position or ()) + ") mm"
