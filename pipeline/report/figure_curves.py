"""Pictures: the found coordinates against flexion, and the checks of contact and repeatability."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.plotting import Chart, Curve, charts_png
from pipeline.kinematics.interpolation import usable_entries
from pipeline.kinematics.table import Status
from pipeline.report.evidence import CURVES, STATUS_WORDS, Evidence, neutral_varus
from pipeline.report.figure_frame import RESEARCH_USE, heading
from pipeline.report.palette import hexadecimal, scale
from pipeline.report.settings import Limits

Float = NDArray[np.float64]

FLEXION = "Flexion (deg)"
SCAN_COLOR = "#d55e00"
BAND_COLOR = "#009e73"
#: Internal rotation by 30 deg of flexion in healthy knees, deg: shown for comparison, never fitted to.
ROTATION_BAND_DEG = (0.0, 13.0)
ROTATION_BAND_AT_DEG = 30.0
_STATUS_COLORS = {
    Status.SLID_OFF: "#d55e00",
    Status.ROTATION_BOUND: "#cc79a7",
    Status.NO_CONTACT: "#000000",
    Status.NOT_CONVERGED: "#e69f00",
}
#: Varus curves that a chart can hold and still be read.
MAX_CURVES = 5


def curves_png(evidence: Evidence) -> bytes:
    """Raw poses, fitted curves, the scan, and where there is no pose, as PNG."""
    charts = [_chart(evidence, name, title, unit) for name, title, unit in CURVES]
    return charts_png(f"{heading(evidence.facts)}  |  Found coordinates", RESEARCH_USE, charts)


def shown_varus(evidence: Evidence) -> list[int]:
    """Indices of at most MAX_CURVES varus values, spread over the grid and with the neutral one."""
    count = len(evidence.smooth.grid.varus_deg)
    spread = np.linspace(0, count - 1, min(count, MAX_CURVES)).round().astype(int).tolist()
    neutral = neutral_varus(evidence.smooth.grid)
    return sorted({neutral, *spread}) if len(spread) < MAX_CURVES or neutral in spread else spread


def varus_colors(evidence: Evidence) -> dict[int, str]:
    """Index of a shown varus -> its colour, dark for the lowest."""
    shown = shown_varus(evidence)
    shares = np.linspace(0.0, 0.88, len(shown)) if len(shown) > 1 else np.array([0.25])
    return {j: hexadecimal(tuple(color)) for j, color in zip(shown, scale(shares).tolist(), strict=True)}


def _chart(evidence: Evidence, name: str, title: str, unit: str) -> Chart:
    raw, smooth = getattr(evidence.raw.poses, name), getattr(evidence.smooth.poses, name)
    flexion, curves = evidence.smooth.grid.flexion_deg, []
    for j, color in varus_colors(evidence).items():
        label = f"varus {evidence.smooth.grid.varus_deg[j]:g} deg"
        curves.append(Curve(evidence.raw.grid.flexion_deg, raw[:, j], color, "dots"))
        curves.append(Curve(flexion, smooth[:, j], color, "line", label))
    if name == "internal_rotation_deg" and flexion[0] < ROTATION_BAND_AT_DEG < flexion[-1]:
        at = np.full(2, ROTATION_BAND_AT_DEG)
        curves.append(Curve(at, np.array(ROTATION_BAND_DEG), BAND_COLOR, "bar", "healthy knees at 30 deg"))
    curves += [*_scan_mark(evidence, name), *_status_marks(evidence, smooth)]
    return Chart(f"{title} ({unit})", FLEXION, unit, curves)


def _scan_mark(evidence: Evidence, name: str) -> Iterator[Curve]:
    flexion, _, rotation, *shift = evidence.anatomy.scan_attitude
    grid = evidence.smooth.grid.flexion_deg
    if grid[0] <= flexion <= grid[-1]:
        value = dict(zip([field for field, _, _ in CURVES], [*shift, rotation], strict=True))[name]
        yield Curve(np.array([flexion]), np.array([value]), SCAN_COLOR, "star", "the scan itself")


def _status_marks(evidence: Evidence, values: Float) -> Iterator[Curve]:
    """Crosses at the foot of a chart where the table has no pose, whatever the varus."""
    known = values[np.isfinite(values)]
    foot = float(known.min()) if known.size else 0.0
    status = evidence.smooth.poses.status
    for kind, color in _STATUS_COLORS.items():
        at = evidence.smooth.grid.flexion_deg[(status == kind).any(axis=1)]
        if len(at):
            yield Curve(at, np.full(len(at), foot), color, "cross", f"no pose: {STATUS_WORDS[kind]}")


def checks_png(evidence: Evidence, limits: Limits) -> bytes:
    """Contact after smoothing with its limit, hysteresis, and the gap of each side against flexion, as PNG.

    Raises
    ------
    ValueError
        When no entry of the table is usable.
    """
    if not usable_entries(evidence.smooth.poses).any():
        raise ValueError("no entry of the table is usable")
    raw, smooth = evidence.raw, evidence.smooth
    middles = (smooth.grid.flexion_deg[1:] + smooth.grid.flexion_deg[:-1]) / 2.0
    flexion, poses = smooth.grid.flexion_deg, smooth.poses
    limit = [_limit_line(flexion, sign * limits.max_midpoint_error_mm) for sign in (1.0, -1.0)]
    between = [*_lines(evidence, middles, smooth.midpoint_error_mm), *limit]
    charts = [
        Chart("Contact error between entries: + gap, - overlap", FLEXION, "mm", between),
        Chart(
            "Hysteresis: way out against way back",
            FLEXION,
            "mm",
            _lines(evidence, raw.grid.flexion_deg, raw.hysteresis_mm),
        ),
        Chart("Gap of the medial side", FLEXION, "mm", _lines(evidence, flexion, poses.medial_gap_mm)),
        Chart("Gap of the lateral side", FLEXION, "mm", _lines(evidence, flexion, poses.lateral_gap_mm)),
    ]
    return charts_png(f"{heading(evidence.facts)}  |  Checks", RESEARCH_USE, charts)


def _lines(evidence: Evidence, flexion: Float, values: Float) -> list[Curve]:
    varus = evidence.smooth.grid.varus_deg
    colors = varus_colors(evidence)
    return [Curve(flexion, values[:, j], color, "line", f"varus {varus[j]:g} deg") for j, color in colors.items()]


def _limit_line(flexion: Float, value: float) -> Curve:
    return Curve(flexion[[0, -1]], np.full(2, value), SCAN_COLOR, "dashed", f"limit {abs(value):g} mm")
