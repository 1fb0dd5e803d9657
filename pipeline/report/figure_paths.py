"""Picture: where the middle of contact wanders on the moving body's joint surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters.plotting import Backdrop, Chart, ColorScale, Curve, Layout, Mark, Points, Words, charts_png
from pipeline.adapters.rendering import Surface, snapshots
from pipeline.geometry.views import View
from pipeline.report.contact_paths import BAND_MM, ContactPath, SideName, contact_paths, excursion_mm
from pipeline.report.evidence import Evidence, neutral_varus
from pipeline.report.figure_curves import FLEXION
from pipeline.report.figure_frame import RESEARCH_USE, heading
from pipeline.report.figure_poses import from_above
from pipeline.report.palette import BLUE, BONE, VERMILION, hexadecimal, scale

Float = NDArray[np.float64]

SIDE_COLORS: dict[SideName, str] = {"medial": BLUE, "lateral": VERMILION}
#: Width and height of the surface behind the paths, pixels; a joint surface is wider than deep.
BACKDROP_PX = (680, 560)


def paths_png(evidence: Evidence) -> bytes:
    """The paths seen from above with a millimetre grid, and how far forwards they lie against flexion, as PNG.

    Raises
    ------
    ValueError
        When no attitude at neutral varus has a contact to show.
    """
    paths = contact_paths(evidence)
    if not any(np.isfinite(path.gap_mm).any() for path in paths):
        raise ValueError("no attitude at neutral varus has a contact to show")
    varus = evidence.smooth.grid.varus_deg[neutral_varus(evidence.smooth.grid)]
    title = f"{heading(evidence.facts)}  |  Paths of contact at varus {varus:g} deg"
    return charts_png(
        title, RESEARCH_USE, [_map(evidence, paths), _forwards(paths)], Layout(row_inches=4.8, legend_columns=4)
    )


def _map(evidence: Evidence, paths: tuple[ContactPath, ...]) -> Chart:
    square = from_above(evidence)
    seen = replace(square, half_height_mm=square.half_height_mm * BACKDROP_PX[1] / BACKDROP_PX[0])
    lines = [Curve(path.lateral_mm, path.anterior_mm, SIDE_COLORS[path.side], "thin") for path in paths]
    flexion = _ends(paths)
    left, right, top, bottom = seen.edges
    return Chart(
        "Moving body from above",
        f"{left}  ←  mm  →  {right}",
        f"{bottom}  ←  mm  →  {top}",
        lines,
        marks=[mark for path in paths for mark in _marks(path, _shares(paths, path))],
        backdrop=_backdrop(evidence, seen),
        scale=ColorScale(FLEXION, flexion, scale(np.linspace(0.0, 1.0, 256))) if flexion[1] > flexion[0] else None,
    )


def _ends(paths: tuple[ContactPath, ...]) -> tuple[float, float]:
    return float(paths[0].flexion_deg[0]), float(paths[0].flexion_deg[-1])


def _shares(paths: tuple[ContactPath, ...], path: ContactPath) -> Float:
    first, last = _ends(paths)
    return (path.flexion_deg - first) / max(last - first, 1.0)


def _backdrop(evidence: Evidence, seen: View) -> Backdrop:
    """The surface, its edges in millimetres of the moving body's frame: reversed where lateral lies on the left."""
    surface = Surface(evidence.moving, np.array(BONE, dtype=np.uint8))
    (pixels,) = snapshots([surface], [seen], BACKDROP_PX)
    frame, half = evidence.scan_from_moving, seen.half_height_mm
    wide = half * BACKDROP_PX[0] / BACKDROP_PX[1]
    x, y, _ = (seen.focus - frame[:3, 3]) @ frame[:3, :3]
    towards_right = float(np.sign(seen.right @ frame[:3, 0]))
    return Backdrop(pixels, (x - towards_right * wide, x + towards_right * wide, y - half, y + half))


def _marks(path: ContactPath, shares: Float) -> Iterator[Mark]:
    """A point for each flexion, hollow where the side is open, and the first and the last flexion in words."""
    x, y, known = path.lateral_mm, path.anterior_mm, np.isfinite(path.gap_mm)
    colors = np.array([hexadecimal((r, g, b)) for r, g, b in scale(shares).tolist()])
    for chosen, hollow in ((path.touching, False), (~path.touching & known, True)):
        if chosen.any():
            yield Points(x[chosen], y[chosen], colors[chosen].tolist(), hollow)
    if known.sum() > 1:
        first, last = (int(at) for at in np.flatnonzero(known)[[0, -1]])
        yield Words(float(x[first]), float(y[first]), f"{path.flexion_deg[first]:g}°", "left")
        yield Words(float(x[last]), float(y[last]), f"{path.flexion_deg[last]:g}°", "right")


def _forwards(paths: tuple[ContactPath, ...]) -> Chart:
    curves: list[Curve] = []
    for path in paths:
        color, open_ = SIDE_COLORS[path.side], ~path.touching
        wanders = f"{excursion_mm(path):.1f} mm from back to front" if path.touching.any() else "touches nowhere"
        curves.append(Curve(path.flexion_deg, path.anterior_mm, color, "line", f"{path.side}: {wanders}"))
        if open_.any():
            words = f"{path.side} side open > {BAND_MM:g} mm"
            curves.append(Curve(path.flexion_deg[open_], path.anterior_mm[open_], color, "rings", words))
    return Chart("Middle of contact: + forwards, - backwards", FLEXION, "mm", curves)
