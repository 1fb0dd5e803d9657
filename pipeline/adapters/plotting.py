"""Line charts with Matplotlib, drawn without a display and without global state.

Matplotlib is imported inside the functions, so that a run that draws nothing does not load it.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import GridSpec, SubplotSpec

Float = NDArray[np.float64]

#: Dots per inch of the file; 100 gives readable text on a screen and on A4.
DPI = 100
#: Least range of a vertical axis, mm or degrees.
MIN_SPAN = 0.2
_LOOKS: dict[str, dict[str, object]] = {
    "line": {"linestyle": "-", "linewidth": 1.8},
    "thin": {"linestyle": "-", "linewidth": 0.9},
    "dashed": {"linestyle": "--", "linewidth": 1.4},
    "dots": {"linestyle": "none", "marker": "o", "markersize": 3.4, "alpha": 0.65, "markeredgewidth": 0.0},
    "squares": {"linestyle": "none", "marker": "s", "markersize": 4.2, "alpha": 0.65, "markeredgewidth": 0.0},
    "rings": {"linestyle": "none", "marker": "o", "markersize": 6.5, "markerfacecolor": "white"},
    "cross": {"linestyle": "none", "marker": "x", "markersize": 6.0, "markeredgewidth": 1.6, "clip_on": False},
    "star": {"linestyle": "none", "marker": "*", "markersize": 13.0, "markeredgecolor": "white"},
    "bar": {"linestyle": "-", "linewidth": 7.0, "alpha": 0.35, "solid_capstyle": "butt"},
    "whisker": {"linestyle": "-", "linewidth": 1.6, "marker": "_", "markersize": 8.0},
}
#: Room in inches for words: beside the charts, between columns, below a chart, above and below it, of the whole sheet.
_LEFT_IN, _RIGHT_IN, _GAP_IN = 1.0, 0.15, 1.05
_X_WORDS_IN, _AXES_WORDS_IN = 0.6, 0.95
_HEADING_IN, _FOOTER_IN, _LEGEND_ROW_IN = 0.4, 0.3, 0.235
#: How opaque a band is: grid and curves show through two of them.
BAND_ALPHA = 0.2
#: Area of a coloured point, square points.
_POINT_SIZE = 46.0
#: How far words stand from their place, points.
_WORDS_AWAY = 7.0


Look = Literal["line", "thin", "dashed", "dots", "squares", "rings", "cross", "star", "bar", "whisker"]


@dataclass(frozen=True, eq=False)
class Curve:
    """Points (N,) and how to draw them; one with an empty ``label`` is not in the legend."""

    x: Float
    y: Float
    color: str
    look: Look = "line"
    label: str = ""


@dataclass(frozen=True, eq=False)
class Band:
    """The area between two curves (N,) over ``x``; a NaN leaves a gap."""

    x: Float
    low: Float
    high: Float
    color: str
    label: str = ""


@dataclass(frozen=True, eq=False)
class Zone:
    """Everything between two places of the horizontal axis."""

    first: float
    last: float
    color: str
    label: str = ""


@dataclass(frozen=True, eq=False)
class Points:
    """Points (N,) with a colour ``#rrggbb`` each; hollow ones have only a rim of it."""

    x: Float
    y: Float
    colors: Sequence[str]
    hollow: bool = False


@dataclass(frozen=True, eq=False)
class Words:
    """A line of text to the left or to the right of a place of a chart."""

    x: float
    y: float
    words: str
    beside: Literal["left", "right"]


@dataclass(frozen=True, eq=False)
class Backdrop:
    """A picture (H, W, 3) behind a chart, and where its left, right, bottom and top edge lie; not stretched."""

    pixels: NDArray[np.uint8]
    edges: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class ColorScale:
    """The scale of a chart's coloured points: what it means, its ends, its colours (K, 3) from end to end."""

    title: str
    ends: tuple[float, float]
    colors: NDArray[np.uint8]


Area = Band | Zone
Mark = Points | Words


@dataclass(frozen=True, eq=False)
class Chart:
    """One pair of axes: areas below curves below marks; the vertical one fits itself where ``y_ends`` does not say."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    areas: Sequence[Area] = ()
    marks: Sequence[Mark] = ()
    backdrop: Backdrop | None = None
    scale: ColorScale | None = None
    y_ends: tuple[float, float] | None = None


@dataclass(frozen=True)
class Layout:
    """How charts are put together; with ``legend_in_cell`` the legend fills what the last row leaves free."""

    columns: int = 2
    row_inches: float = 3.6
    legend_columns: int = 5
    legend_in_cell: bool = False


def charts_png(heading: str, footer: str, charts: Sequence[Chart], layout: Layout = Layout()) -> bytes:
    """PNG bytes of charts in a grid with one legend; the same input gives the same bytes.

    Parameters
    ----------
    heading, footer : str
        Above and below the charts.
    charts : sequence of Chart
    layout : Layout
    """
    import matplotlib  # noqa: PLC0415
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    # Names come from the user: a dollar sign must not be taken for mathematics.
    with matplotlib.rc_context({"text.parse_math": False, "font.size": 11.0, "axes.grid": True, "grid.alpha": 0.3}):
        figure = Figure(dpi=DPI)
        rows = -(-len(charts) // layout.columns)
        cells = figure.add_gridspec(rows, layout.columns)
        for number, chart in enumerate(charts):
            _draw(figure.add_subplot(cells[divmod(number, layout.columns)]), chart)
        legend_rows = _legend(
            figure, cells[divmod(len(charts), layout.columns)] if layout.legend_in_cell else None, layout
        )
        _lay_out(figure, cells, layout, legend_rows)
        width, height = figure.get_size_inches()
        figure.text(0.1 / width, 1.0 - 0.1 / height, heading, fontsize=15, fontweight="bold", va="top")
        figure.text(
            1.0 - 0.1 / width, 0.1 / height, footer, fontsize=10, fontweight="bold", color="#6e6e6e", ha="right"
        )
        data = io.BytesIO()
        # what savefig does, but for drawing the charts twice
        FigureCanvasAgg(figure).print_png(data, metadata={"Software": None})  # type: ignore[no-untyped-call]
    return data.getvalue()


def _legend(figure: Figure, cell: SubplotSpec | None, layout: Layout) -> int:
    """Put the one legend below the charts or into a cell; the number of its rows below."""
    entries = [axes.get_legend_handles_labels() for axes in figure.axes]
    handles = {label: handle for found in entries for handle, label in zip(*found, strict=True)}
    look: dict[str, Any] = {"ncols": layout.legend_columns, "frameon": False}
    if cell is not None:
        axes = figure.add_subplot(cell)
        axes.set_axis_off()
        axes.legend(handles.values(), handles.keys(), loc="center left", **look)
        return 0
    if handles:
        look |= {"loc": "lower left", "bbox_to_anchor": (0.0, _FOOTER_IN), "bbox_transform": figure.dpi_scale_trans}
        figure.legend(handles.values(), handles.keys(), borderaxespad=0.4, **look)
    return -(-len(handles) // layout.legend_columns)


def _lay_out(figure: Figure, cells: GridSpec, layout: Layout, legend_rows: int) -> None:
    """Fixed margins: to measure every text first takes longer than to draw it."""
    rows, columns = cells.get_geometry()
    width = 7.0 * columns
    foot = _FOOTER_IN + _LEGEND_ROW_IN * legend_rows
    height = layout.row_inches * rows + _HEADING_IN + foot
    figure.set_size_inches(width, height)
    axes_width = (width - _LEFT_IN - _RIGHT_IN - _GAP_IN * (columns - 1)) / columns
    axes_height = layout.row_inches - _AXES_WORDS_IN
    figure.subplots_adjust(
        left=_LEFT_IN / width,
        right=1.0 - _RIGHT_IN / width,
        wspace=_GAP_IN / axes_width,
        bottom=(foot + _X_WORDS_IN) / height,
        top=1.0 - (_HEADING_IN + _AXES_WORDS_IN - _X_WORDS_IN) / height,
        hspace=_AXES_WORDS_IN / axes_height,
    )


def _draw(axes: Axes, chart: Chart) -> None:
    axes.set_title(chart.title, loc="left", fontweight="bold")
    axes.set_xlabel(chart.x_label)
    axes.set_ylabel(chart.y_label)
    if chart.backdrop is not None:
        # room on the right for a scale
        axes.set_anchor("W")
        axes.imshow(chart.backdrop.pixels, extent=chart.backdrop.edges, aspect="equal", interpolation="bilinear")
    for area in chart.areas:
        _draw_area(axes, area)
    for curve in chart.curves:
        # A line of one point would be a blank.
        looks = ({"marker": "o"} if len(curve.x) == 1 else {}) | _LOOKS[curve.look]
        # A leading underscore keeps an entry out of the legend.
        axes.plot(curve.x, curve.y, color=curve.color, label=curve.label or "_", **looks)  # type: ignore[arg-type]
    for mark in chart.marks:
        _draw_mark(axes, mark)
    if chart.scale is not None:
        _draw_scale(axes, chart.scale)
    if chart.backdrop is not None:
        return
    axes.margins(x=0.02)
    if chart.y_ends is not None:
        axes.set_ylim(chart.y_ends)
    low, high = axes.get_ylim()
    # Rounding noise must not fill a chart.
    if high - low < MIN_SPAN:
        middle = round((low + high) / 2.0, 6)
        axes.set_ylim(middle - MIN_SPAN / 2.0, middle + MIN_SPAN / 2.0)


def _draw_area(axes: Axes, area: Area) -> None:
    look = {"color": area.color, "alpha": BAND_ALPHA, "linewidth": 0.0, "label": area.label or "_"}
    if isinstance(area, Band):
        axes.fill_between(area.x, area.low, area.high, **look)  # type: ignore[arg-type]
    else:
        axes.axvspan(area.first, area.last, **look)  # type: ignore[arg-type]


def _draw_mark(axes: Axes, mark: Mark) -> None:
    if isinstance(mark, Points):
        faces = "white" if mark.hollow else list(mark.colors)
        rims = list(mark.colors) if mark.hollow else "white"
        axes.scatter(mark.x, mark.y, s=_POINT_SIZE, c=faces, edgecolors=rims, linewidths=1.2, zorder=3)
        return
    away = -_WORDS_AWAY if mark.beside == "left" else _WORDS_AWAY
    plate = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.0}
    align: Literal["left", "right"] = "right" if mark.beside == "left" else "left"
    axes.annotate(
        mark.words,
        (mark.x, mark.y),
        xytext=(away, 0.0),
        textcoords="offset points",
        ha=align,
        va="center",
        bbox=plate,
        # below the points, which matter more
        zorder=2.5,
    )


def _draw_scale(axes: Axes, scale: ColorScale) -> None:
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415
    from matplotlib.colors import ListedColormap, Normalize  # noqa: PLC0415

    shades = ScalarMappable(Normalize(*scale.ends), ListedColormap(scale.colors / 255.0))
    beside = axes.inset_axes((1.02, 0.0, 0.04, 1.0))
    axes.figure.colorbar(shades, cax=beside, label=scale.title)
