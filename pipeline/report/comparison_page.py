"""The page of two tables compared: one self-contained HTML file without script, the same bytes for the same tables."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np

from pipeline import __version__
from pipeline.adapters.plotting import Chart, Curve, charts_png
from pipeline.kinematics.comparison import Comparison
from pipeline.kinematics.interpolation import FOUND
from pipeline.report.evidence import CURVES, neutral_varus
from pipeline.report.figure_curves import FLEXION, MAX_CURVES
from pipeline.report.figure_frame import RESEARCH_USE
from pipeline.report.palette import hexadecimal, scale
from pipeline.report.templates import environment

TEMPLATE = "comparison.html.j2"
FIRST_COLOR, SECOND_COLOR = "#0072b2", "#d55e00"


@dataclass(frozen=True)
class ComparedTable:
    """What the page says of one table: case ID or file name, joint, side, the program that made it."""

    label: str
    joint: str
    side: str
    software: str

    @property
    def heading(self) -> str:
        """Such as ``P001, RIGHT knee``."""
        return f"{self.label}, {self.side.upper()} {self.joint}"


@dataclass(frozen=True, eq=False)
class ComparisonPage:
    """All that the page shows."""

    first: ComparedTable
    second: ComparedTable
    comparison: Comparison


def comparison_html(page: ComparisonPage) -> bytes:
    """The page with its pictures embedded; every text from a table is escaped."""
    grid, found = page.comparison.grid, {curve.name: curve for curve in page.comparison.curves}
    pictures = {"Both motions at neutral varus": motions_png(page), "The difference": differences_png(page)}
    return (
        environment()
        .get_template(TEMPLATE)
        .render(
            research_use=RESEARCH_USE,
            software=f"ct2lut {__version__}",
            first=page.first,
            second=page.second,
            rows=[(title, unit, found[name]) for name, title, unit in CURVES],
            flexion=grid.flexion_deg[[0, -1]].tolist(),
            varus=grid.varus_deg[[0, -1]].tolist(),
            neutral=float(grid.varus_deg[neutral_varus(grid)]),
            shared=page.comparison.shared,
            attitudes=grid.shape[0] * grid.shape[1],
            pictures={title: base64.b64encode(data).decode() for title, data in pictures.items()},
        )
        .encode()
    )


def motions_png(page: ComparisonPage) -> bytes:
    """The coordinates of both against flexion at the shared varus nearest to zero, as PNG."""
    both = page.comparison
    flexion, column = both.grid.flexion_deg, neutral_varus(both.grid)
    charts = [
        Chart(
            f"{title} ({unit})",
            FLEXION,
            unit,
            [
                Curve(flexion, both.first[:, column, FOUND.index(name)], FIRST_COLOR, "line", "first"),
                Curve(flexion, both.second[:, column, FOUND.index(name)], SECOND_COLOR, "dashed", "second"),
            ],
        )
        for name, title, unit in CURVES
    ]
    return charts_png(_heading(page), RESEARCH_USE, charts)


def differences_png(page: ComparisonPage) -> bytes:
    """Second minus first against flexion, one line for each of at most five varus values, as PNG."""
    both = page.comparison
    varus, difference = both.grid.varus_deg, both.difference
    columns = sorted({int(j) for j in np.linspace(0, len(varus) - 1, min(len(varus), MAX_CURVES)).round()})
    colors = [hexadecimal(tuple(color)) for color in scale(np.linspace(0.0, 0.88, len(columns))).tolist()]
    charts = [
        Chart(
            f"{title}: second minus first ({unit})",
            FLEXION,
            unit,
            [
                Curve(both.grid.flexion_deg, difference[:, j, FOUND.index(name)], color, "line", f"varus {varus[j]:g}")
                for j, color in zip(columns, colors, strict=True)
            ],
        )
        for name, title, unit in CURVES
    ]
    return charts_png(_heading(page), RESEARCH_USE, charts)


def _heading(page: ComparisonPage) -> str:
    return f"First: {page.first.heading}  |  Second: {page.second.heading}"
