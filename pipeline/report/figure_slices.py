"""Picture: the CT, or else the label map, cut in three planes, with the outlines of the surfaces made from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters import pictures
from pipeline.adapters.pictures import Image
from pipeline.geometry.sections import plane_section, volume_slice
from pipeline.geometry.views import Direction, View, view
from pipeline.geometry.volume import CtVolume
from pipeline.report.evidence import Evidence
from pipeline.report.figure_frame import finished, mark_edges, title_panel
from pipeline.report.palette import structure_color
from pipeline.report.settings import PictureSettings
from pipeline.suggestions import plain

Float = NDArray[np.float64]

#: Part of the joint's width that a slice shows above and below its centre.
HALF_HEIGHT_OF_WIDTH = 0.75
PANEL_SHARE = 1.3
#: Bone window: black and white of a CT, HU.
WINDOW_HU = (-250.0, 1250.0)
AIR_HU = -1024
_PALE = (225, 225, 225)


def slices_picture(evidence: Evidence, settings: PictureSettings) -> Image:
    """Coronal, two sagittal and axial cuts of the CT, or of the label map where the case brought none.

    Raises
    ------
    ValueError
        When the case has neither.
    """
    cuts, size = _cuts(evidence, settings), _size(settings)
    if evidence.ct_cuts is not None:
        title = f"CT (bone window, {WINDOW_HU[0]:.0f} to {WINDOW_HU[1]:.0f} HU) and outlines of the surfaces (colour)"
        greys = [_windowed(values) for values in evidence.ct_cuts]
    elif evidence.labels is not None:
        title = "Label map (grey, the case brought no CT) and outlines of the surfaces (colour)"
        greys = [_greys(volume_slice(evidence.labels, cut, (size, size))) for _, cut in cuts]
    else:
        raise ValueError("the case brought surfaces, neither CT nor label map")
    panels = [_panel(evidence, grey, words, cut) for grey, (words, cut) in zip(greys, cuts, strict=True)]
    legend = [(plain(name), structure_color(name)) for name in evidence.meshes]
    return finished(evidence.facts, title, [pictures.tiled([panels])], legend)


def ct_cuts(evidence: Evidence, ct: CtVolume, settings: PictureSettings) -> tuple[NDArray[np.generic], ...]:
    """(size, size) CT numbers on each plane of the picture: all that a report needs of a CT."""
    size = _size(settings)
    return tuple(volume_slice(ct, cut, (size, size), AIR_HU) for _, cut in _cuts(evidence, settings))


def _size(settings: PictureSettings) -> int:
    return round(settings.panel_px * PANEL_SHARE)


def _cuts(evidence: Evidence, settings: PictureSettings) -> list[tuple[str, View]]:
    frame, joint = evidence.scan_from_reference, evidence.scan_from_moving[:3, 3]
    across = _across(evidence)
    half = min(HALF_HEIGHT_OF_WIDTH * float(np.ptp(across)), settings.field_of_view_mm / 2.0)
    # As on a radiologist's screen: anterior at the left of a sagittal cut, the patient's left at the right of an axial.
    sagittal: Direction = "medial" if np.linalg.det(frame[:3, :3]) > 0.0 else "lateral"
    medial, lateral = (joint + float(x) * frame[:3, 0] for x in np.percentile(across, (22, 78)))
    return [
        ("coronal", view(frame, "anterior", joint, half)),
        ("sagittal, medial", view(frame, sagittal, medial, half)),
        ("sagittal, lateral", view(frame, sagittal, lateral, half)),
        ("axial, flexion axis", view(frame, "distal", frame[:3, 3], half)),
    ]


def _across(evidence: Evidence) -> Float:
    """Lateral positions of the reference body, from the joint's centre, near the joint."""
    frame, joint = evidence.scan_from_reference, evidence.scan_from_moving[:3, 3]
    offset = (evidence.reference.points - joint) @ frame[:3, :3]
    near = np.abs(offset[:, 2]) < 0.5 * np.ptp(offset[:, 0])
    return np.asarray(offset[near if near.any() else slice(None), 0])


def _panel(evidence: Evidence, panel: Image, words: str, cut: View) -> Image:
    size = len(panel)
    for name, mesh in evidence.meshes.items():
        segments = plane_section(mesh, cut.focus, cut.toward)
        ends = cut.pixels(segments.reshape(-1, 3), (size, size)).reshape(-1, 2, 2)
        pictures.draw_segments(panel, ends, structure_color(name), 2)
    title_panel(panel, words, pictures.PAPER)
    mark_edges(panel, cut, _PALE)
    return panel


def _greys(labels: NDArray[np.generic]) -> Image:
    """Grey levels that differ between neighbouring label values; background nearly black."""
    values = labels.astype(np.int64)
    grey = np.where(values > 0, 70 + 23 * (values % 5), 18).astype(np.uint8)
    return _grey_image(grey)


def _windowed(values: NDArray[np.generic]) -> Image:
    """CT numbers as a screen shows them."""
    return _grey_image(np.interp(values.astype(np.float64), WINDOW_HU, (0.0, 255.0)).astype(np.uint8))


def _grey_image(grey: NDArray[np.uint8]) -> Image:
    return np.ascontiguousarray(np.repeat(grey[..., None], 3, axis=2))
