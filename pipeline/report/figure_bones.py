"""Picture: the surfaces as scanned, from four sides, with landmarks, axes and delta."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters import pictures
from pipeline.adapters.pictures import BOLD, Color, Image, Text
from pipeline.adapters.rendering import Surface, snapshots
from pipeline.geometry.views import Direction, View, view
from pipeline.report.evidence import Evidence
from pipeline.report.figure_frame import MARGIN_PX, finished, mark_edges, title_panel
from pipeline.report.palette import AXIS, DELTA, structure_color
from pipeline.report.settings import PictureSettings
from pipeline.suggestions import plain

Float = NDArray[np.float64]

SIDES: tuple[Direction, ...] = ("anterior", "lateral", "medial", "posterior")
PANEL_SHARE = 1.3
LANDMARK: Color = (0, 0, 0)
#: Lengths of the drawn axes as parts of the panel's half height.
AXIS_SHARE, DELTA_SHARE = 0.55, 0.45
#: Long axis -> the landmark that it is drawn through.
SHAFT_OF = {"femoral_long_axis": "femur_shaft_centre", "tibial_long_axis": "tibia_shaft_centre"}


def bones_picture(evidence: Evidence, settings: PictureSettings) -> Image:
    """All structures at the pose of the scan."""
    size = round(settings.panel_px * PANEL_SHARE)
    surfaces = [Surface(mesh, np.array(structure_color(name), np.uint8)) for name, mesh in evidence.meshes.items()]
    focus = (evidence.scan_from_reference[:3, 3] + evidence.scan_from_moving[:3, 3]) / 2.0
    views = [view(evidence.scan_from_reference, side, focus, half_height_mm(evidence, settings)) for side in SIDES]
    images = snapshots(surfaces, views, (size, size))
    for image, seen, side in zip(images, views, SIDES, strict=True):
        _annotate(image, evidence, seen)
        title_panel(image, f"seen from {side}")
        mark_edges(image, seen)
    legend = [(plain(name), structure_color(name)) for name in evidence.meshes]
    sheet = pictures.tiled([images])
    title = "Bones as scanned; blue: flexion axis and long axes, orange: push, black: landmarks; all drawn through bone"
    return finished(evidence.facts, title, [sheet, *_landmark_list(evidence, sheet.shape[1])], legend)


def half_height_mm(evidence: Evidence, settings: PictureSettings) -> float:
    """Half of what a panel shows: all of the two bodies, or the field of view where they are longer."""
    center = evidence.scan_from_reference[:3, 3]
    reach = max(float(np.linalg.norm(m.points - center, axis=1).max()) for m in (evidence.reference, evidence.moving))
    return min(1.05 * reach, settings.field_of_view_mm / 2.0)


def _annotate(image: Image, evidence: Evidence, seen: View) -> None:
    reference, moving = evidence.scan_from_reference, evidence.scan_from_moving
    length = AXIS_SHARE * seen.half_height_mm
    flexion = reference[:3, 3] + np.outer([-length, length], reference[:3, 0])
    push = moving[:3, 3] + np.outer([-DELTA_SHARE * seen.half_height_mm, 0.0], evidence.anatomy.delta)
    _axis(image, seen, flexion, "flexion axis")
    for ends in _long_axes(evidence, length):
        _axis(image, seen, ends, "")
    size = (image.shape[1], image.shape[0])
    ends = seen.pixels(push, size)
    pictures.draw_arrow(image, ends, DELTA)
    pictures.draw_tag(image, Text("Δ push", 15, BOLD, DELTA), (ends[0, 0] + 6, ends[0, 1]))
    _landmarks(image, evidence, seen)


def _long_axes(evidence: Evidence, length: float) -> Iterator[Float]:
    """(2, 3) ends of each long axis, through the centre of its shaft; only those that anatomy found."""
    centers = {mark.name: np.array(mark.position) for mark in evidence.anatomy.landmarks}
    joint = evidence.scan_from_moving[:3, 3]
    for axis in evidence.anatomy.axes:
        center = centers.get(SHAFT_OF.get(axis.name, ""))
        if center is not None:
            direction = np.array(axis.direction) * np.sign(np.dot(axis.direction, joint - center))
            yield center + np.outer([-0.4 * length, length], direction)


def _axis(image: Image, seen: View, ends: Float, words: str) -> None:
    pixels = seen.pixels(ends, (image.shape[1], image.shape[0]))
    if np.linalg.norm(pixels[1] - pixels[0]) < 0.1 * image.shape[0]:
        pictures.draw_dots(image, pixels[:1], AXIS, 4.0)
        return
    pictures.draw_segments(image, pixels[None], AXIS, 2)
    tip = pixels[np.argmax(pixels[:, 0])]
    if words:
        pictures.draw_tag(image, Text(words, 14, color=AXIS), (tip[0], tip[1] + 17), 1.0)


def _landmarks(image: Image, evidence: Evidence, seen: View) -> None:
    if not evidence.anatomy.landmarks:
        return
    points = np.array([landmark.position for landmark in evidence.anatomy.landmarks])
    pixels = seen.pixels(points, (image.shape[1], image.shape[0]))
    pictures.draw_dots(image, pixels, LANDMARK, 4.0)
    for number, (x, y) in enumerate(_spread(pixels), start=1):
        pictures.draw_tag(image, Text(str(number), 14, BOLD), (x + 7, y + 5))


def _spread(pixels: Float, apart_px: float = 16.0) -> Float:
    """Positions of labels, moved down where two would cover one another."""
    out = pixels.copy()
    for i in np.argsort(pixels[:, 1], kind="stable"):
        for j in range(len(out)):
            close = np.abs(out[i] - out[j]) < apart_px
            if j != i and close.all() and out[j, 1] <= out[i, 1]:
                out[i, 1] = out[j, 1] + apart_px
    return out


def _landmark_list(evidence: Evidence, width: int) -> Sequence[Image]:
    words = [
        f"{number} {plain(mark.name)} ({mark.source}, ±{mark.uncertainty_mm:.1f} mm)"
        for number, mark in enumerate(evidence.anatomy.landmarks, start=1)
    ]
    rows = [words[i : i + 4] for i in range(0, len(words), 4)]
    strip = pictures.blank(width, 22 * len(rows) + 8)
    for y, row in enumerate(rows):
        for x, entry in enumerate(row):
            pictures.draw_text(strip, Text(entry, 15), (MARGIN_PX + x * width / 4, 22 * (y + 1)))
    return [strip] if words else []
