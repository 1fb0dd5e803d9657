"""Pictures: the table at neutral varus beside simpler and published motions, and what ignoring the surfaces costs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.plotting import Band, Chart, Curve, Layout, Zone, charts_png
from pipeline.kinematics.baselines import Baseline, hinge, walker
from pipeline.kinematics.interpolation import usable_runs
from pipeline.records import BaselineCost, BaselineName
from pipeline.report.evidence import CURVES, Evidence, neutral_varus
from pipeline.report.figure_curves import FLEXION, scan_mark
from pipeline.report.figure_frame import RESEARCH_USE, heading
from pipeline.report.palette import AMBER, BLUE, GREEN, GREY, PINK, VERMILION
from pipeline.report.published import CHANGES, EXTENSION_DEG, JOINT, WALKER_SOURCE, PublishedChange
from pipeline.report.settings import Limits

Float = NDArray[np.float64]

#: What is usual of the distance between dots and line is taken over so much flexion to either side, degrees.
USUAL_WITHIN_DEG = 10.0
#: Bending and straightening that differ by more end in different poses.
APART_MM, APART_DEG = 1.0, 2.0
#: Axes whose errors shift the whole curve of an angle.
_AXES_OF = {
    "internal_rotation_deg": ("flexion_axis", "tibial_mediolateral_axis"),
    "varus_deg": ("flexion_axis", "tibial_long_axis"),
}
_BASELINE_LOOKS: dict[BaselineName, tuple[str, str]] = {
    "hinge": (AMBER, "plain hinge"),
    "walker": (PINK, f"average motion ({WALKER_SOURCE})"),
}


class _Line(NamedTuple):
    """One coordinate at neutral varus: where it was found, and the fit (None where there is none)."""

    name: str
    flexion_deg: Float
    found: Float
    fitted: Float | None


def neutral_png(evidence: Evidence) -> bytes:
    """Five coordinates against the sixth, flexion: found, fitted, how sure, baselines, published ranges; as PNG."""
    column = neutral_varus(evidence.smooth.grid)
    varus = evidence.smooth.grid.varus_deg[column]
    charts = [_coordinate_chart(evidence, *curve) for curve in CURVES] + [_varus_chart(evidence)]
    title = f"{heading(evidence.facts)}  |  At varus {varus:g} deg, beside simpler and published motions"
    return charts_png(title, RESEARCH_USE, charts, Layout(legend_columns=1, legend_in_cell=True))


def _coordinate_chart(evidence: Evidence, name: str, title: str, unit: str) -> Chart:
    column, flexion = neutral_varus(evidence.smooth.grid), evidence.smooth.grid.flexion_deg
    found, fitted = (getattr(table.poses, name)[:, column] for table in (evidence.raw, evidence.smooth))
    line, spread = _Line(name, flexion, found, fitted), _usual(flexion, found - fitted)
    areas: list[Band | Zone] = [
        *_published_spans(evidence, line),
        *_two_poses(evidence),
        Band(flexion, fitted - spread, fitted + spread, BLUE, "how far dots usually lie off the line nearby (RMS)"),
    ]
    curves = [
        Curve(flexion, found, BLUE, "dots", "this knee, as found"),
        Curve(flexion, fitted, BLUE, "line", "this knee, smoothed (the table)"),
        *_baselines(evidence, name),
        *scan_mark(evidence, name),
        *_published_bars(evidence, line),
        *_axes_whisker(evidence, name, evidence.anatomy.scan_attitude[2]),
    ]
    return Chart(f"{title} ({unit})", FLEXION, unit, curves, areas)


def _usual(flexion_deg: Float, residual: Float) -> Float:
    """(F,) root mean square of the residuals that are near in flexion; NaN where there is none."""
    near = (np.abs(flexion_deg[:, None] - flexion_deg) <= USUAL_WITHIN_DEG) & np.isfinite(residual)
    count = near.sum(axis=1)
    sums = (near * np.nan_to_num(residual) ** 2).sum(axis=1)
    return np.asarray(np.sqrt(np.divide(sums, count, out=np.full(len(count), np.nan), where=count > 0)))


def _two_poses(evidence: Evidence) -> Iterator[Zone]:
    """Flexions at which bending and straightening end in different poses, where that is known of this varus."""
    raw, column = evidence.raw, neutral_varus(evidence.smooth.grid)
    apart = (raw.hysteresis_mm[:, column] > APART_MM) | (raw.hysteresis_deg[:, column] > APART_DEG)
    flexion = raw.grid.flexion_deg
    words = f"bending and straightening differ by > {APART_MM:g} mm or {APART_DEG:g} deg: two poses"
    for run in usable_runs(apart):
        yield Zone(float(flexion[run.start]), float(flexion[run.stop - 1]), GREY, words)


def _varus_chart(evidence: Evidence) -> Chart:
    neutral, grid = evidence.neutral, evidence.smooth.grid
    line = _Line("varus_deg", neutral.flexion_deg, neutral.varus_deg, None)
    here = np.full(len(grid.flexion_deg), grid.varus_deg[neutral_varus(grid)])
    curves = [
        Curve(neutral.flexion_deg, neutral.varus_deg, BLUE, "dots", "this knee, as found"),
        Curve(grid.flexion_deg, here, BLUE, "thin", "varus of the other four charts"),
        *_baselines(evidence, "varus_deg"),
        *_published_bars(evidence, line),
        *_axes_whisker(evidence, "varus_deg", evidence.anatomy.scan_attitude[1]),
    ]
    return Chart(
        "Varus at which both sides touch (deg)", FLEXION, "deg", curves, list(_published_spans(evidence, line))
    )


def _baselines(evidence: Evidence, name: str) -> Iterator[Curve]:
    """The baselines that the sweep was asked to try."""
    for cost in evidence.sweep.baselines:
        color, label = _BASELINE_LOOKS[cost.name]
        motion = _motion(evidence, cost.name)
        yield Curve(motion.flexion_deg, getattr(motion, name), color, "dashed", label)


def _motion(evidence: Evidence, name: BaselineName) -> Baseline:
    curve = {"hinge": hinge, "walker": walker}[name]
    return curve(evidence.smooth.grid.flexion_deg, evidence.anatomy.scan_attitude)


class _Comparable(NamedTuple):
    """A published change within the table, and this knee's own value in extension, on which it is laid."""

    change: PublishedChange
    own: float
    label: str


def _comparable(evidence: Evidence, line: _Line) -> Iterator[_Comparable]:
    own = _in_extension(line)
    if evidence.facts.joint != JOINT or own is None:
        return
    for change in CHANGES:
        if change.coordinate == line.name and change.flexion_deg[0] <= line.flexion_deg[-1]:
            yield _Comparable(change, own, f"{change.knees} ({change.source})")


def _published_bars(evidence: Evidence, line: _Line) -> Iterator[Curve]:
    for change, own, label in _comparable(evidence, line):
        if change.at_one_flexion:
            yield Curve(np.array(change.flexion_deg), own + np.array(change.change_deg), GREEN, "bar", label)


def _published_spans(evidence: Evidence, line: _Line) -> Iterator[Band]:
    for change, own, label in _comparable(evidence, line):
        if not change.at_one_flexion:
            low, high = (np.full(2, own + value) for value in change.change_deg)
            yield Band(np.minimum(change.flexion_deg, line.flexion_deg[-1]), low, high, GREEN, label)


def _in_extension(line: _Line) -> float | None:
    """The coordinate at the first flexion where it is known, if that is extension."""
    values = line.found if line.fitted is None else line.fitted
    known = np.flatnonzero(np.isfinite(values))
    if not len(known) or abs(line.flexion_deg[known[0]]) > EXTENSION_DEG:
        return None
    return float(values[known[0]])


def _axes_whisker(evidence: Evidence, name: str, value: float) -> Iterator[Curve]:
    """One standard deviation of the axes that an angle is measured against, at the scan."""
    spread = {axis.name: axis.uncertainty_deg for axis in evidence.anatomy.axes}
    axes, flexion = _AXES_OF.get(name, ()), evidence.anatomy.scan_attitude[0]
    grid = evidence.smooth.grid.flexion_deg
    if axes and all(axis in spread for axis in axes) and grid[0] <= flexion <= grid[-1]:
        away = float(np.linalg.norm([spread[axis] for axis in axes]))
        ends = np.array([value - away, value + away])
        yield Curve(np.full(2, flexion), ends, VERMILION, "whisker", "how well the axes are known (1 SD)")


def baselines_png(evidence: Evidence, limits: Limits) -> bytes:
    """Gap or overlap of the baselines and of this table, and of this table alone, against flexion, as PNG.

    Raises
    ------
    ValueError
        When no pose of a baseline meets the other body.
    """
    costs = evidence.sweep.baselines
    if not any(cost.way_mm for cost in costs):
        raise ValueError("no pose of a baseline meets the other body")
    flexion, most = evidence.smooth.grid.flexion_deg[[0, -1]], limits.max_midpoint_error_mm
    limit = [Curve(flexion, np.full(2, sign * most), VERMILION, "dashed", f"limit {most:g} mm") for sign in (1.0, -1.0)]
    own = _own_ways(evidence)
    charts = [
        Chart("All three: + gap, - overlap", FLEXION, "mm", [*(_cost(cost) for cost in costs), *own]),
        Chart("This table alone, enlarged", FLEXION, "mm", [*own, *limit]),
    ]
    title = f"{heading(evidence.facts)}  |  What a motion costs that ignores the surfaces"
    return charts_png(title, RESEARCH_USE, charts, Layout(legend_columns=2))


def _cost(cost: BaselineCost) -> Curve:
    color, label = _BASELINE_LOOKS[cost.name]
    ways = np.array(cost.way_mm)
    overlap, gap = (float(np.max(values, initial=0.0)) for values in (-ways, ways))
    words = f"{label}: overlap up to {overlap:.1f} mm, gap up to {gap:.1f} mm"
    return Curve(np.array(cost.flexion_deg), ways, color, "line", words)


def _own_ways(evidence: Evidence) -> list[Curve]:
    smooth, column = evidence.smooth, neutral_varus(evidence.smooth.grid)
    flexion = smooth.grid.flexion_deg
    at, between = smooth.contact_error_mm[:, column], smooth.midpoint_error_mm[:, column]
    places = np.concatenate([flexion, (flexion[1:] + flexion[:-1]) / 2.0])
    order, ways = np.argsort(places, kind="stable"), np.concatenate([at, between])
    worst = float(np.nanmax(np.abs(ways), initial=0.0)) if np.isfinite(ways).any() else float("nan")
    words = f"this table at varus {smooth.grid.varus_deg[column]:g} deg: at most {worst:.2f} mm off contact"
    return [Curve(places[order], ways[order], BLUE, "line", words)]
