"""Line charts with Matplotlib, drawn without a display and without global state.

Matplotlib is imported inside the functions, so that a run that draws nothing does not load it.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Float = NDArray[np.float64]

#: Dots per inch of the file; 100 gives readable text on a screen and on A4.
DPI = 100
#: Least range of a vertical axis, mm or degrees.
MIN_SPAN = 0.2
_LOOKS: dict[str, dict[str, object]] = {
    "line": {"linestyle": "-", "linewidth": 1.8},
    "dashed": {"linestyle": "--", "linewidth": 1.4},
    "dots": {"linestyle": "none", "marker": "o", "markersize": 3.4, "alpha": 0.65, "markeredgewidth": 0.0},
    "cross": {"linestyle": "none", "marker": "x", "markersize": 6.0, "markeredgewidth": 1.6, "clip_on": False},
    "star": {"linestyle": "none", "marker": "*", "markersize": 13.0, "markeredgecolor": "white"},
    "bar": {"linestyle": "-", "linewidth": 7.0, "alpha": 0.35, "solid_capstyle": "butt"},
}


@dataclass(frozen=True, eq=False)
class Curve:
    """Points (N,) and how to draw them; one with an empty ``label`` is not in the legend."""

    x: Float
    y: Float
    color: str
    look: Literal["line", "dashed", "dots", "cross", "star", "bar"] = "line"
    label: str = ""


@dataclass(frozen=True, eq=False)
class Chart:
    """One pair of axes."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]


def charts_png(heading: str, footer: str, charts: Sequence[Chart], columns: int = 2) -> bytes:
    """PNG bytes of charts in a grid with one legend below; the same input gives the same bytes.

    Parameters
    ----------
    heading, footer : str
        Above and below the charts.
    charts : sequence of Chart
    columns : int
    """
    import matplotlib  # noqa: PLC0415
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    rows = -(-len(charts) // columns)
    # Names come from the user: a dollar sign must not be taken for mathematics.
    with matplotlib.rc_context({"text.parse_math": False, "font.size": 11.0, "axes.grid": True, "grid.alpha": 0.3}):
        figure = Figure(figsize=(7.0 * columns, 3.6 * rows + 1.5), dpi=DPI, layout="constrained")
        figure.suptitle(heading, fontsize=15, fontweight="bold", x=0.01, ha="left")
        for number, chart in enumerate(charts, start=1):
            _draw(figure.add_subplot(rows, columns, number), chart)
        entries = [axes.get_legend_handles_labels() for axes in figure.axes]
        handles = {label: handle for found in entries for handle, label in zip(*found, strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside lower left", ncols=5, frameon=False)
        figure.supxlabel(footer, x=0.99, ha="right", fontsize=10, fontweight="bold", color="#6e6e6e")
        data = io.BytesIO()
        # what savefig does, but for laying the charts out and drawing them twice
        FigureCanvasAgg(figure).print_png(data, metadata={"Software": None})  # type: ignore[no-untyped-call]
    return data.getvalue()


def _draw(axes: Axes, chart: Chart) -> None:
    axes.set_title(chart.title, loc="left", fontweight="bold")
    axes.set_xlabel(chart.x_label)
    axes.set_ylabel(chart.y_label)
    for curve in chart.curves:
        looks = dict(_LOOKS[curve.look])
        # A leading underscore keeps an entry out of the legend.
        axes.plot(curve.x, curve.y, color=curve.color, label=curve.label or "_", **looks)  # type: ignore[arg-type]
    axes.margins(x=0.02)
    low, high = axes.get_ylim()
    # Rounding noise must not fill a chart.
    if high - low < MIN_SPAN:
        middle = (low + high) / 2.0
        axes.set_ylim(middle - MIN_SPAN / 2.0, middle + MIN_SPAN / 2.0)
