"""The table of stable poses over the grid of attitudes: types shared by sweep, smoothing and playback."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


class Status(IntEnum):
    """What became of one cell; the numbers are those of ``lut.h5``."""

    OK = 0
    SMOOTHED = 1
    SLID_OFF = 2
    ROTATION_BOUND = 3
    NO_CONTACT = 4
    NOT_CONVERGED = 5

    @property
    def usable(self) -> bool:
        """Whether the pose of the cell may be shown."""
        return self <= Status.SMOOTHED

    @property
    def words(self) -> str:
        """What became of the cell, for people."""
        return _STATUS_WORDS[self]


_STATUS_WORDS = {
    Status.OK: "stable pose found",
    Status.SMOOTHED: "filled by smoothing",
    Status.SLID_OFF: "slid off",
    Status.ROTATION_BOUND: "rotated to its bound",
    Status.NO_CONTACT: "no contact",
    Status.NOT_CONVERGED: "search did not end",
}


@dataclass(frozen=True, eq=False)
class Grid:
    """Attitudes of the table: flexion (F,) and varus (V,), degrees, strictly increasing."""

    flexion_deg: Float
    varus_deg: Float

    @property
    def shape(self) -> tuple[int, int]:
        """(F, V)."""
        return len(self.flexion_deg), len(self.varus_deg)


@dataclass(frozen=True, eq=False)
class PoseTable:
    """One pose per cell, all arrays (F, V); NaN where ``status`` is not usable.

    Attributes
    ----------
    lateral_mm, anterior_mm, proximal_mm : float64
        d = (x, y, z) of the moving body in the attitude frame.
    internal_rotation_deg : float64
        Rotation about delta, internal positive.
    status : uint8
        Values of Status.
    equilibrium_residual : float64
        Of the certificate; 0 is perfect equilibrium, 1 is none.
    medial_gap_mm, lateral_gap_mm : float64
        Smallest distance between the bodies in the medial and in the lateral compartment.
    contact_count : int32
        Contacts within the contact band.
    """

    lateral_mm: Float
    anterior_mm: Float
    proximal_mm: Float
    internal_rotation_deg: Float
    status: NDArray[np.uint8]
    equilibrium_residual: Float
    medial_gap_mm: Float
    lateral_gap_mm: Float
    contact_count: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class RawTable:
    """The sweep as found, before smoothing.

    Attributes
    ----------
    grid, poses
    iterations : (F, V) int32
        Motions the solver made.
    gap_before_mm, gap_after_mm : (F, V) float64
        Proof on both sides: pulled back by ``gap_before_mm`` the bodies are clear, pushed on by ``gap_after_mm``
        they intersect (exact triangle test).
    hysteresis_mm, hysteresis_deg : (F, V) float64
        Way out against way back along flexion, known in the column nearest the scan's varus: length of the difference
        of (x, y, z), and of the rotation; NaN elsewhere and where not both are usable.
    margin_lateral_mm, margin_anterior_mm, margin_rotation_deg : (F, V) float64
        How far each coordinate may be pushed, the others held, while the depth keeps falling (coarse); NaN where the
        solver cannot tell.
    """

    grid: Grid
    poses: PoseTable
    iterations: NDArray[np.int32]
    gap_before_mm: Float
    gap_after_mm: Float
    hysteresis_mm: Float
    hysteresis_deg: Float
    margin_lateral_mm: Float
    margin_anterior_mm: Float
    margin_rotation_deg: Float


@dataclass(frozen=True, eq=False)
class CurveFit:
    """Least-squares polynomial of one found coordinate over the grid.

    Attributes
    ----------
    coefficients : (P + 1, Q + 1) float64
        In the Chebyshev basis of flexion (degree P) and varus (degree Q), both scaled to [-1, 1].
    residual_rms, residual_max : float
        Raw minus fitted, in the curve's unit.
    """

    name: str
    unit: str
    coefficients: Float
    residual_rms: float
    residual_max: float


@dataclass(frozen=True, eq=False)
class SmoothTable:
    """The table after smoothing, contact re-established along delta, and re-tested.

    Attributes
    ----------
    grid, poses
    fits : tuple of CurveFit
        lateral_mm, anterior_mm, internal_rotation_deg.
    flexion_range_deg, varus_range_deg : (2,) float64
        Ends that the basis scales to -1 and 1.
    contact_error_mm : (F, V) float64
        Signed way along delta from the entry to first contact, + gap, - intersection; found by exact test.
    midpoint_error_mm : (F - 1, V) float64
        The same half-way between flexion entries, interpolated as a reader would; NaN beside an unusable entry.
    """

    grid: Grid
    poses: PoseTable
    fits: tuple[CurveFit, ...]
    flexion_range_deg: Float
    varus_range_deg: Float
    contact_error_mm: Float
    midpoint_error_mm: Float


@dataclass(frozen=True, eq=False)
class LutTable:
    """The look-up table as playback needs it.

    Attributes
    ----------
    side : str
        ``right`` or ``left``.
    grid, poses
    scan_from_reference, scan_from_moving : (4, 4) float64
        Kinematic frames in scan space (LPS mm).
    """

    side: str
    grid: Grid
    poses: PoseTable
    scan_from_reference: Float
    scan_from_moving: Float
