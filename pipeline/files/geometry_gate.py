"""The gate that the geometry of every volume passes, label map or CT, of whatever format."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.foreign_image import ForeignImage, not_finite
from pipeline.geometry.volume import axis_codes, shear

#: Largest |cosine| between axes that is rounding of a header, not shear.
MAX_SHEAR = 1e-4
#: Voxel sizes that scanners make; outside this the unit is wrong.
SPACING_MM = (0.1, 5.0)
#: The smallest side may be a crop of a finger joint (20 mm), the largest a whole body (2.5 m).
EXTENT_MM = (20.0, 2500.0)


def check_geometry(lps_from_index: NDArray[np.float64], shape: tuple[int, ...], file: str) -> None:
    """Refuse a matrix that no scanner gives.

    Parameters
    ----------
    lps_from_index : (4, 4) float64
    shape : tuple of int
        Of the voxels.
    file : str
        For messages.

    Raises
    ------
    CaseRejected
        E-GEO-03 not finite or flat, E-GEO-04 sheared, E-GEO-06 voxel size, E-GEO-07 extent.
    """
    if not np.isfinite(lps_from_index).all() or abs(np.linalg.det(lps_from_index[:3, :3])) < 1e-12:
        raise not_finite(file)
    if not (oblique := shear(lps_from_index)) <= MAX_SHEAR:
        degrees = float(np.degrees(np.arcsin(min(oblique, 1.0))))
        raise CaseRejected(
            "E-GEO-04",
            f"The axes of {file} are not at right angles: {degrees:.3g} deg off, expected below {MAX_SHEAR} rad.",
            "Undo the gantry tilt or shear by resampling the CT before it is segmented.",
        )
    spacing = np.linalg.norm(lps_from_index[:3, :3], axis=0)
    action = "Check the unit and the voxel size of the export."
    if outside := _outside(spacing, SPACING_MM):
        raise CaseRejected("E-GEO-06", f"The voxel size of {file} is {outside}.", action)
    if outside := _outside(spacing * np.asarray(shape[:3]), EXTENT_MM):
        raise CaseRejected("E-GEO-07", f"The extent of {file} is {outside}.", action)


def handedness(image: ForeignImage, file: str) -> tuple[Finding, ...]:
    """A note where the axes of a file are left-handed."""
    if np.linalg.det(image.lps_from_index[:3, :3]) > 0:
        return ()
    text = (
        f"{file} stores its axes left-handed ({axis_codes(image.lps_from_index)}); one axis was reversed together "
        "with its voxels, so that nothing is mirrored."
    )
    return (Finding("N-GEO-01", Severity.NOTE, text),)


def _outside(actual_mm: NDArray[np.float64], limits_mm: tuple[float, float]) -> str:
    """Empty when the three lengths are within the limits, else a description with a guess at the unit."""
    low, high = limits_mm
    if actual_mm.min() >= low and actual_mm.max() <= high:
        return ""
    guess = "metres" if actual_mm.max() < high / 500 else "micrometres" if actual_mm.min() > low * 500 else ""
    lengths = " x ".join(f"{x:.4g}" for x in actual_mm)
    return f"{lengths} mm, expected {low:g} to {high:g} mm" + (f" (it looks like {guess})" if guess else "")
