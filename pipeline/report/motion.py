"""The film of the report: the joint bends and straightens, seen from two sides.

Played in a loop, so the poses of the way out are shown again on the way back and no bone jumps where the film begins
anew. Between the entries of the table the poses are those that every player shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters import pictures
from pipeline.adapters.decimation import decimate_quadric
from pipeline.adapters.movie import webm
from pipeline.adapters.pictures import BOLD, Image, Text
from pipeline.adapters.rendering import Surface, snapshots
from pipeline.geometry.mesh import TriangleMesh, transformed
from pipeline.geometry.views import Direction, View, view
from pipeline.kinematics.interpolation import found_at, motion_map, motions, pose_curves, usable_entries
from pipeline.report.evidence import Evidence, neutral_varus
from pipeline.report.figure_bones import half_height_mm
from pipeline.report.figure_frame import (
    MARGIN_PX,
    RESEARCH_USE,
    heading,
    mark_edges,
    title_panel,
    words_panel,
)
from pipeline.report.figure_poses import body_colors, carried, structures_legend
from pipeline.report.figures import Caption, Figure
from pipeline.report.palette import structure_color
from pipeline.report.settings import Limits, PictureSettings
from pipeline.suggestions import plain

Float = NDArray[np.float64]

TEMPLATE = "motion.html.j2"
SIDES: tuple[Direction, ...] = ("lateral", "anterior")
#: 31 poses of 120 degrees: out and back in five seconds.
FRAMES_PER_SECOND = 12.0
#: Most triangles of one body: with the 60,000 of a real knee a frame looks the same and takes more than twice as long.
TRIANGLES = 6_000
#: The same for a structure that goes with the moving body.
CARRIED_TRIANGLES = 1_500
HEADING_PX, ATTITUDE_PX = 24, 20
#: Heights of what is above the panels, and of the empty strip at the bottom, over which browsers lay their controls.
HEADER_PX, CONTROLS_PX = 86, 64


@dataclass(frozen=True, eq=False)
class _Scene:
    """What stays the same from frame to frame; ``moving`` are the surfaces at the pose of the scan."""

    reference: Surface
    moving: tuple[Surface, ...]
    views: tuple[View, ...]
    panel_px: int
    paper: Image


def expected_motion(evidence: Evidence) -> tuple[Figure, ...]:
    """The film, which the report of a case must have; none where the table holds a single flexion."""
    return (MOTION,) if len(evidence.smooth.grid.flexion_deg) > 1 else ()


def motion_frames(evidence: Evidence, settings: PictureSettings) -> list[Image]:
    """Frames from the lowest to the highest flexion with a pose at neutral varus, all of one size.

    A flexion between the two that has no pose is a frame that says so.

    Raises
    ------
    ValueError
        When fewer than two flexions have a pose at neutral varus.
    """
    flexion_deg, varus_deg, scan_motions = _attitudes(evidence, settings.motion_poses)
    scene = _scene(evidence, settings)
    return [
        _frame(scene, f"flexion {flexion:.1f}°, varus {varus_deg:.1f}°", motion)
        for flexion, motion in zip((flexion_deg.round(1) + 0.0).tolist(), scan_motions, strict=True)
    ]


# a function of the module, not a lambda: a figure is sent to a worker process
def _film(evidence: Evidence, settings: PictureSettings, _: Limits) -> bytes:
    out = motion_frames(evidence, settings)
    return webm([*out, *out[-2::-1]], FRAMES_PER_SECOND)


MOTION = Figure(
    "motion",
    "Film: the joint bends and straightens",
    Caption(
        "Poses of the table at neutral varus, from the lowest to the highest flexion and back; the upper bone stands "
        "still, and what the table does not move, such as a kneecap, is left out.",
        "The lower bone glides evenly round the upper one, and both sides stay in touch all the way.",
        "The lower bone jumps, sinks in, floats or turns suddenly, or frames say that there is no stable pose.",
        "Stop the film there, read the flexion off the frame, and look at the curves and the contact picture near it.",
    ),
    _film,
    "video/webm",
)


def _attitudes(evidence: Evidence, count: int) -> tuple[Float, float, Float]:
    """Flexion (N,) in degrees, the varus of all, and (N, 4, 4) motions in scan space; NaN where there is no pose."""
    grid, poses = evidence.smooth.grid, evidence.smooth.poses
    neutral = neutral_varus(grid)
    usable = np.flatnonzero(usable_entries(poses)[:, neutral])
    if len(usable) < 2:
        raise ValueError("fewer than two flexions have a stable pose at neutral varus")
    flexion_deg = np.linspace(grid.flexion_deg[usable[0]], grid.flexion_deg[usable[-1]], count)
    varus_deg = np.full(count, grid.varus_deg[neutral])
    found = found_at(pose_curves(grid, poses), flexion_deg, varus_deg)
    to_scan = motion_map(evidence.scan_from_reference, evidence.scan_from_moving)
    return flexion_deg, float(varus_deg[0]) + 0.0, motions(to_scan, flexion_deg, varus_deg, found)


def _scene(evidence: Evidence, settings: PictureSettings) -> _Scene:
    reference, moving = _fewer(evidence.reference, TRIANGLES), _fewer(evidence.moving, TRIANGLES)
    lighter = replace(evidence, reference=reference, moving=moving)
    others = (
        Surface(_fewer(evidence.meshes[name], CARRIED_TRIANGLES), np.array(structure_color(name), np.uint8))
        for name in carried(evidence, settings)
    )
    focus, half = evidence.scan_from_reference[:3, 3], half_height_mm(evidence, settings)
    return _Scene(
        Surface(reference, body_colors(lighter, "reference")),
        (Surface(moving, body_colors(lighter, "moving")), *others),
        tuple(view(evidence.scan_from_reference, side, focus, half) for side in SIDES),
        settings.panel_px,
        _paper(evidence, settings),
    )


def _fewer(mesh: TriangleMesh, most: int) -> TriangleMesh:
    return mesh if len(mesh.triangles) <= most else decimate_quadric(mesh, most)


def _paper(evidence: Evidence, settings: PictureSettings) -> Image:
    """Whose joint it is, notice and legend around the place of the panels, of even height and width."""
    also = [(plain(name), structure_color(name)) for name in carried(evidence, settings)]
    legend, size = [*structures_legend(evidence), *also], settings.panel_px
    room = pictures.tiled([[pictures.blank(size, size)] * len(SIDES)])
    width = room.shape[1]
    header, key = pictures.blank(width, HEADER_PX), pictures.blank(width, pictures.legend_height(legend, width))
    pictures.draw_text(header, _fitting(heading(evidence.facts), width - 2 * MARGIN_PX), (MARGIN_PX, 28))
    pictures.draw_text(header, Text(RESEARCH_USE, 15, BOLD, pictures.GREY), (MARGIN_PX, 49))
    pictures.draw_legend(key, legend, (MARGIN_PX, 24))
    strip = pictures.blank(width, CONTROLS_PX + (size + len(key)) % 2)
    return np.vstack([header, room, key, strip])


def _fitting(words: str, width_px: int) -> Text:
    """A heading in letters small enough that nothing of it is cut, and the side stands at its end."""
    full = pictures.text_width(Text(words, HEADING_PX, BOLD))
    return Text(words, min(HEADING_PX, HEADING_PX * width_px // full), BOLD)


def _frame(scene: _Scene, attitude: str, motion: Float) -> Image:
    frame, size = scene.paper.copy(), scene.panel_px
    panels = _panels(scene, motion) if np.isfinite(motion).all() else [words_panel(size, ["No stable pose here"])] * 2
    frame[HEADER_PX : HEADER_PX + size] = pictures.tiled([panels])
    pictures.draw_text(frame, Text(attitude, ATTITUDE_PX, BOLD), (MARGIN_PX, 77))
    return frame


def _panels(scene: _Scene, motion: Float) -> list[Image]:
    moved = [Surface(transformed(surface.mesh, motion), surface.color) for surface in scene.moving]
    panels = snapshots([scene.reference, *moved], scene.views, (scene.panel_px, scene.panel_px))
    for panel, seen, side in zip(panels, scene.views, SIDES, strict=True):
        title_panel(panel, f"seen from {side}")
        mark_edges(panel, seen)
    return panels
