"""Pictures: the joint at several flexions, and how near its surfaces come to one another."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters import pictures
from pipeline.adapters.pictures import Color, Image, Text
from pipeline.adapters.rendering import Surface, distances_mm, snapshots
from pipeline.geometry.mesh import TriangleMesh, transformed
from pipeline.geometry.views import View, view
from pipeline.report.evidence import Cell, Evidence, cell_motion, shown_cells
from pipeline.report.figure_bones import SIDES, half_height_mm
from pipeline.report.figure_frame import finished, mark_edges, title_panel, words_panel
from pipeline.report.palette import BONE, MOVING, OVERLAP, scale, structure_color
from pipeline.report.settings import PictureSettings
from pipeline.suggestions import plain

Float = NDArray[np.float64]

#: Overlap that is coloured as such; the eye sees no less (0.145 mm is one arc minute from 0.5 m).
OVERLAP_MM = 0.145
CONTACT_SHARE = 1.1
#: How deep the part of the moving body that is its top reaches, as part of its width.
TOP_OF_WIDTH = 0.5
#: Half of a contact panel as part of what it shows; the rest is for the words at its edges.
ABOVE_HALF = 0.62


def poses_picture(evidence: Evidence, settings: PictureSettings) -> Image:
    """The bodies that touch, at several flexions from four sides; the reference stands still.

    Raises
    ------
    ValueError
        When no attitude that is shown has a pose.
    """
    cells = _usable_cells(evidence, settings)
    colors = [body_colors(evidence, "reference"), body_colors(evidence, "moving")]
    half = half_height_mm(evidence, settings)
    views = [view(evidence.scan_from_reference, side, evidence.scan_from_reference[:3, 3], half) for side in SIDES]
    columns = [_pose_column(evidence, settings, cell, views, colors) for cell in cells]
    rows = [list(row) for row in zip(*columns, strict=True)]
    return finished(
        evidence.facts, _poses_title(evidence, settings), [pictures.tiled(rows)], structures_legend(evidence)
    )


def _poses_title(evidence: Evidence, settings: PictureSettings) -> str:
    shown = {*settings.carried, *(origin.structure for origin in evidence.origins)}
    left_out = [plain(name) for name in evidence.meshes if name not in shown]
    title = "Poses of the look-up table at neutral varus"
    return f"{title}; left out, as the table does not move it: {', '.join(left_out)}" if left_out else title


def _usable_cells(evidence: Evidence, settings: PictureSettings) -> tuple[Cell, ...]:
    cells = shown_cells(evidence.smooth, settings.flexions_deg)
    if not any(cell.status.usable for cell in cells):
        raise ValueError("no attitude that is shown has a stable pose")
    return cells


def _title(cell: Cell) -> str:
    return f"flexion {cell.flexion_deg:g}°, varus {cell.varus_deg:g}°"


def _no_pose(cell: Cell, size: int) -> Image:
    panel = words_panel(size, ["No stable pose here:", cell.status.words])
    title_panel(panel, _title(cell))
    return panel


def _pose_column(
    evidence: Evidence, settings: PictureSettings, cell: Cell, views: list[View], colors: list[NDArray[np.uint8]]
) -> list[Image]:
    size = settings.panel_px
    if not cell.status.usable:
        return [_no_pose(cell, size) for _ in views]
    motion = cell_motion(evidence, cell)
    surfaces = [Surface(evidence.reference, colors[0]), Surface(transformed(evidence.moving, motion), colors[1])]
    surfaces += [
        Surface(transformed(evidence.meshes[name], motion), np.array(structure_color(name), np.uint8))
        for name in carried(evidence, settings)
    ]
    panels = snapshots(surfaces, views, (size, size))
    for panel, seen in zip(panels, views, strict=True):
        title_panel(panel, _title(cell))
        mark_edges(panel, seen)
    return panels


def carried(evidence: Evidence, settings: PictureSettings) -> list[str]:
    """Structures that go with the moving body though they are no part of its contact surface."""
    return [name for name in settings.carried if name in evidence.meshes]


def body_colors(evidence: Evidence, body: str) -> NDArray[np.uint8]:
    """(N, 3) colour of each vertex of a body: that of the structure it lies on."""
    mesh = evidence.reference if body == "reference" else evidence.moving
    names = [o.structure for o in evidence.origins if o.body == body and o.structure in evidence.meshes]
    if not names:
        return np.tile(np.array(BONE if body == "reference" else MOVING, dtype=np.uint8), (len(mesh.points), 1))
    vertices = [evidence.meshes[name].points for name in names]
    structure = np.repeat(np.arange(len(names)), [len(points) for points in vertices])
    _, nearest = _nearest_vertex(mesh.points, np.concatenate(vertices))
    palette = np.array([structure_color(name) for name in names], dtype=np.uint8)
    return np.asarray(palette[structure[nearest]])


def _nearest_vertex(points: Float, vertices: Float, reach_mm: float = np.inf) -> tuple[Float, NDArray[np.intp]]:
    """(N,) distance to the nearest vertex, and its number; infinite and without meaning beyond ``reach_mm``."""
    from scipy.spatial import KDTree  # noqa: PLC0415  - a cached run must not load it

    distance, nearest = KDTree(vertices).query(points, distance_upper_bound=reach_mm)
    return np.asarray(distance), np.asarray(nearest)


def structures_legend(evidence: Evidence) -> list[tuple[str, Color]]:
    """Name and colour of each structure of both bodies; in words which of them the program made."""
    words = {"labelled": "{}", "synthesised": "{} (made by the program)"}
    return [
        (words[o.origin].format(plain(o.structure)), structure_color(o.structure))
        for o in evidence.origins
        if o.origin in words and o.structure in evidence.meshes
    ]


def contact_picture(evidence: Evidence, settings: PictureSettings) -> Image:
    """The moving body from above, coloured by its distance to the reference, at several flexions.

    Raises
    ------
    ValueError
        When no attitude that is shown has a pose.
    """
    cells = _usable_cells(evidence, settings)
    seen = from_above(evidence)
    colors = _contact_colors(evidence, settings, cells)
    panels = [_contact_panel(evidence, settings, cell, seen, colors.get(cell)) for cell in cells]
    bar = pictures.color_bar(scale(np.linspace(0.0, 1.0, 256)), _bar_labels(settings), panels[0].shape[1] * 2)
    legend = [(f"farther than {settings.contact_range_mm:g} mm", BONE), ("overlap beyond 0.145 mm", OVERLAP)]
    title = "Moving body seen from proximal, coloured by its distance to the other body; dark is contact"
    return finished(evidence.facts, title, [pictures.tiled([panels]), bar], legend)


def from_above(evidence: Evidence) -> View:
    """The top of the moving body seen along delta, all of it on the picture."""
    frame = evidence.scan_from_moving
    local = (evidence.moving.points - frame[:3, 3]) @ frame[:3, :3]
    top = local[local[:, 2] > local[:, 2].max() - TOP_OF_WIDTH * np.ptp(local[:, 0])]
    low, high = top.min(axis=0), top.max(axis=0)
    middle = np.array([*(low + high)[:2] / 2.0, 0.0])
    return view(frame, "proximal", frame[:3, 3] + frame[:3, :3] @ middle, ABOVE_HALF * float((high - low)[:2].max()))


def _bar_labels(settings: PictureSettings) -> list[str]:
    return [f"{value:g} mm" for value in np.linspace(0.0, settings.contact_range_mm, 5)]


def _contact_colors(
    evidence: Evidence, settings: PictureSettings, cells: Iterable[Cell]
) -> dict[Cell, NDArray[np.uint8]]:
    """Of the moving body's vertices in each cell that has a pose; all at once, since the search tree takes long."""
    usable = [cell for cell in cells if cell.status.usable]
    placed = [transformed(evidence.moving, cell_motion(evidence, cell)).points for cell in usable]
    distance = near_distances(np.concatenate(placed), evidence.reference, settings.contact_range_mm)
    colors = distance_colors(distance, settings)
    return dict(zip(usable, np.split(colors, len(usable)), strict=True))


def _contact_panel(
    evidence: Evidence, settings: PictureSettings, cell: Cell, seen: View, colors: NDArray[np.uint8] | None
) -> Image:
    size = round(settings.panel_px * CONTACT_SHARE)
    if colors is None:
        return _no_pose(cell, size)
    (panel,) = snapshots([Surface(evidence.moving, colors, plain=True)], [seen], (size, size))
    title_panel(panel, _title(cell))
    mark_edges(panel, seen)
    _write_gaps(panel, evidence, cell)
    return panel


def near_distances(points: Float, mesh: TriangleMesh, reach_mm: float) -> Float:
    """(N,) signed distance of points to a surface; infinite where surely beyond ``reach_mm``."""
    edge = mesh.points[mesh.triangles[:, 0]] - mesh.points[mesh.triangles[:, 1]]
    longest = float(np.linalg.norm(edge, axis=1).max())
    # The way to a surface is at right angles to it, and there a vertex is no farther than the longest edge / sqrt(3).
    far = np.hypot(reach_mm, longest / np.sqrt(3.0))
    near = np.isfinite(_nearest_vertex(points, mesh.points, far)[0])
    out = np.full(len(points), np.inf)
    out[near] = distances_mm(points[near], mesh)
    return out


def distance_colors(distance: Float, settings: PictureSettings) -> NDArray[np.uint8]:
    """(N, 3) colours of distances: the scale within range, bone beyond, and a warning where bodies overlap."""
    colors = scale(np.minimum(distance / settings.contact_range_mm, 1.0))
    colors[distance > settings.contact_range_mm] = BONE
    colors[distance < -OVERLAP_MM] = OVERLAP
    return colors


def _write_gaps(panel: Image, evidence: Evidence, cell: Cell) -> None:
    at = (cell.flexion_index, cell.varus_index)
    poses = evidence.smooth.poses
    gaps: Iterable[tuple[str, float]] = (("medial", poses.medial_gap_mm[at]), ("lateral", poses.lateral_gap_mm[at]))
    words = "gap " + ", ".join(f"{side} {abs(value):.2f} mm" for side, value in gaps if np.isfinite(value))
    pictures.draw_tag(panel, Text(words, 14), (panel.shape[1] / 2, panel.shape[0] - 28), 0.5)
