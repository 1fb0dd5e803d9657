"""Pictures: contact against flexion, and how sure a pose is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.plotting import Chart, Curve, Layout, charts_png
from pipeline.kinematics.interpolation import usable_entries
from pipeline.report.evidence import Evidence, neutral_varus
from pipeline.report.figure_curves import FLEXION, varus_colors
from pipeline.report.figure_frame import RESEARCH_USE, heading
from pipeline.report.palette import AMBER, BLUE, GREEN, PINK, VERMILION
from pipeline.report.published import HYSTERESIS_BELOW_DEG, HYSTERESIS_SOURCE, JOINT
from pipeline.report.settings import Limits

Float = NDArray[np.float64]

#: How far the search for a stability margin goes.
MOST_SHIFT_MM, MOST_TURN_DEG = 5.0, 10.0


def checks_png(evidence: Evidence, limits: Limits) -> bytes:
    """Contact after smoothing with its limits, and the gap of each side, against flexion, as PNG.

    Raises
    ------
    ValueError
        When no entry of the table is usable.
    """
    if not usable_entries(evidence.smooth.poses).any():
        raise ValueError("no entry of the table is usable")
    smooth, flexion = evidence.smooth, evidence.smooth.grid.flexion_deg
    middles = (flexion[1:] + flexion[:-1]) / 2.0
    at, between = limits.max_contact_error_mm, limits.max_midpoint_error_mm
    charts = [
        _chart(
            "Contact at the entries: + gap, - overlap",
            [*_lines(evidence, flexion, smooth.contact_error_mm), *_limits(flexion, at)],
        ),
        _chart(
            "Contact between entries: + gap, - overlap",
            [*_lines(evidence, middles, smooth.midpoint_error_mm), *_limits(flexion, between)],
        ),
        _chart("Gap of the medial side", _lines(evidence, flexion, smooth.poses.medial_gap_mm)),
        _chart("Gap of the lateral side", _lines(evidence, flexion, smooth.poses.lateral_gap_mm)),
    ]
    return charts_png(f"{heading(evidence.facts)}  |  Contact", RESEARCH_USE, charts)


def _chart(title: str, curves: list[Curve], unit: str = "mm") -> Chart:
    return Chart(title, FLEXION, unit, curves)


def _lines(evidence: Evidence, flexion: Float, values: Float) -> list[Curve]:
    varus = evidence.smooth.grid.varus_deg
    colors = varus_colors(evidence)
    return [Curve(flexion, values[:, j], color, "line", f"varus {varus[j]:g} deg") for j, color in colors.items()]


def _limits(flexion: Float, value: float) -> list[Curve]:
    ends = flexion[[0, -1]]
    return [Curve(ends, np.full(2, sign * value), VERMILION, "dashed", "limit") for sign in (1.0, -1.0)]


def repeatability_known(evidence: Evidence) -> bool:
    """Whether anything is known of how sure a pose is: not so of a table of one attitude from the paper's solver."""
    return bool(_repeat_charts(evidence))


def repeats_png(evidence: Evidence) -> bytes:
    """Way out against way back, the other solver, and the stability margins, against flexion, as PNG.

    Raises
    ------
    ValueError
        When nothing of it is known.
    """
    charts = _repeat_charts(evidence)
    if not charts:
        raise ValueError("neither the way back, nor the other solver, nor a margin is known")
    return charts_png(
        f"{heading(evidence.facts)}  |  How sure a pose is", RESEARCH_USE, charts, Layout(legend_columns=3)
    )


def _repeat_charts(evidence: Evidence) -> list[Chart]:
    charts = (_hysteresis(evidence), _other_solver(evidence), _shift_margin(evidence), _turn_margin(evidence))
    return [chart for chart in charts if chart is not None]


def _hysteresis(evidence: Evidence) -> Chart | None:
    raw, flexion = evidence.raw, evidence.raw.grid.flexion_deg
    known = np.isfinite(raw.hysteresis_mm) & np.isfinite(raw.hysteresis_deg)
    if not known.any():
        return None
    column = int(known.any(axis=0).argmax())
    curves = [
        Curve(flexion, raw.hysteresis_mm[:, column], BLUE, "line", "shift (mm)"),
        Curve(flexion, raw.hysteresis_deg[:, column], PINK, "line", "rotation (deg)"),
    ]
    if evidence.facts.joint == JOINT:
        yard_stick = np.full(2, HYSTERESIS_BELOW_DEG)
        curves.append(Curve(flexion[[0, -1]], yard_stick, PINK, "dashed", HYSTERESIS_SOURCE))
    varus = raw.grid.varus_deg[column]
    return _chart(f"Bending against straightening (hysteresis), varus {varus:g} deg", curves, "mm, deg")


def _other_solver(evidence: Evidence) -> Chart | None:
    rows = [(one.flexion_deg, one.shift_mm, one.rotation_deg) for one in evidence.sweep.cross_check.attitudes]
    if not rows:
        return None
    flexion, shift, turn = np.array(rows).T
    curves = [
        Curve(flexion, shift, BLUE, "dots"),
        Curve(flexion, turn, PINK, "squares"),
    ]
    return _chart(f"Against the other solver: {len(rows)} attitudes, any varus", curves, "mm, deg")


def _shift_margin(evidence: Evidence) -> Chart | None:
    raw = evidence.raw
    curves = [
        *_margins(evidence, raw.margin_lateral_mm, GREEN, "sideways (mm)"),
        *_margins(evidence, raw.margin_anterior_mm, AMBER, "forwards or backwards (mm)"),
    ]
    return _margin_chart(evidence, "shifts", curves, ("mm", MOST_SHIFT_MM)) if curves else None


def _turn_margin(evidence: Evidence) -> Chart | None:
    curves = _margins(evidence, evidence.raw.margin_rotation_deg, PINK, "rotation (deg)")
    return _margin_chart(evidence, "rotation", curves, ("deg", MOST_TURN_DEG)) if curves else None


def _margins(evidence: Evidence, values: Float, color: str, words: str) -> list[Curve]:
    """The margin at neutral varus, and the least of all varus."""
    if not np.isfinite(values).any():
        return []
    flexion = evidence.raw.grid.flexion_deg
    here, least = values[:, neutral_varus(evidence.raw.grid)], np.fmin.reduce(values, axis=1)
    return [Curve(flexion, here, color, "line", words), Curve(flexion, least, color, "dashed")]


def _margin_chart(evidence: Evidence, of: str, curves: list[Curve], most: tuple[str, float]) -> Chart:
    unit, tried = most
    grid = evidence.raw.grid
    title = f"Stability margin of {of}, varus {grid.varus_deg[neutral_varus(grid)]:g} deg (broken: worst)"
    return Chart(title, FLEXION, f"{unit} (no more than {tried:g} is tried)", curves, y_ends=(0.0, 1.1 * tried))
