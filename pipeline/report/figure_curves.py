"""Picture: the found coordinates against flexion, at several varus."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.plotting import Chart, Curve, charts_png
from pipeline.kinematics.table import Status
from pipeline.report.evidence import CURVES, Evidence, neutral_varus
from pipeline.report.figure_frame import RESEARCH_USE, heading
from pipeline.report.palette import VERMILION, hexadecimal, scale

Float = NDArray[np.float64]

FLEXION = "Flexion (deg)"
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
    curves += [*scan_mark(evidence, name), *_status_marks(evidence, smooth)]
    return Chart(f"{title} ({unit})", FLEXION, unit, curves)


def scan_mark(evidence: Evidence, name: str) -> Iterator[Curve]:
    """The scan's own value of a coordinate, where the table reaches its flexion."""
    flexion, _, rotation, *shift = evidence.anatomy.scan_attitude
    grid = evidence.smooth.grid.flexion_deg
    if grid[0] <= flexion <= grid[-1]:
        value = dict(zip([field for field, _, _ in CURVES], [*shift, rotation], strict=True))[name]
        yield Curve(np.array([flexion]), np.array([value]), VERMILION, "star", "the scan itself")


def _status_marks(evidence: Evidence, values: Float) -> Iterator[Curve]:
    """Crosses at the foot of a chart where the table has no pose, whatever the varus."""
    known = values[np.isfinite(values)]
    foot = float(known.min()) if known.size else 0.0
    status = evidence.smooth.poses.status
    for kind, color in _STATUS_COLORS.items():
        at = evidence.smooth.grid.flexion_deg[(status == kind).any(axis=1)]
        if len(at):
            yield Curve(at, np.full(len(at), foot), color, "cross", f"no pose: {kind.words}")
