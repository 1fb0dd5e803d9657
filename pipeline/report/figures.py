"""The pictures that a report must have, each with the four lines that tell a reader how to look at it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pipeline.adapters.pictures import png
from pipeline.report.evidence import Evidence
from pipeline.report.figure_bones import bones_picture
from pipeline.report.figure_curves import checks_png, curves_png
from pipeline.report.figure_poses import contact_picture, poses_picture
from pipeline.report.figure_slices import slices_picture
from pipeline.report.settings import Limits, PictureSettings


@dataclass(frozen=True)
class Caption:
    """What a picture is, how a good and a bad one look, and what to do about a bad one."""

    what: str
    good: str
    bad: str
    action: str


@dataclass(frozen=True)
class Figure:
    """A picture of the report: file name without ending, title, caption, and how it is drawn (PNG bytes)."""

    name: str
    title: str
    caption: Caption
    draw: Callable[[Evidence, PictureSettings, Limits], bytes]


@dataclass(frozen=True)
class Drawn:
    """A figure and its PNG bytes, or empty bytes and why there are none."""

    figure: Figure
    data: bytes
    problem: str = ""


# functions of the module, not lambdas: a figure is sent to a worker process
def _slices(evidence: Evidence, settings: PictureSettings, _: Limits) -> bytes:
    return png(slices_picture(evidence, settings))


def _bones(evidence: Evidence, settings: PictureSettings, _: Limits) -> bytes:
    return png(bones_picture(evidence, settings))


def _poses(evidence: Evidence, settings: PictureSettings, _: Limits) -> bytes:
    return png(poses_picture(evidence, settings))


def _contact(evidence: Evidence, settings: PictureSettings, _: Limits) -> bytes:
    return png(contact_picture(evidence, settings))


def _curves(evidence: Evidence, _: PictureSettings, __: Limits) -> bytes:
    return curves_png(evidence)


def _checks(evidence: Evidence, _: PictureSettings, limits: Limits) -> bytes:
    return checks_png(evidence, limits)


SLICES = Figure(
    "slices",
    "Surfaces in three planes",
    Caption(
        "Cuts through the CT, or the label map where there is none (grey), with the outlines of the surfaces (colour).",
        "Every outline runs along the border of its bone or grey area, and cartilage lies on its bone.",
        "An outline leaves its bone, a structure is missing or sits on the wrong bone, left and right are exchanged.",
        "Correct the segmentation, or the label names in case.yaml, and run the case again.",
    ),
    _slices,
)
BONES = Figure(
    "bones",
    "Bones, landmarks and axes",
    Caption(
        "The surfaces at the pose of the scan with the landmarks, the flexion axis, the long axes and the push Δ.",
        "The flexion axis passes through both condyles, long axes run along their shafts, Δ along the lower bone.",
        "An axis leaves its bone or is clearly tilted; a landmark lies on the wrong side or off the bone.",
        "Place the landmark in 3D Slicer, save landmarks.mrk.json beside the label map, and run the case again.",
    ),
    _bones,
)
POSES = Figure(
    "poses",
    "The joint at several flexions",
    Caption(
        "Poses of the table at neutral varus, from four sides; the first bone stands still.",
        "Both sides rest on one another at every flexion, and the lower bone turns evenly.",
        "A bone floats, sinks in, slides off or turns suddenly.",
        "Look at the curves at that flexion; check axes and contact surfaces before the table is used there.",
    ),
    _poses,
)
CONTACT = Figure(
    "contact",
    "Where the surfaces touch",
    Caption(
        "The joint surface of the moving body from above, coloured by its distance to the other body.",
        "One dark spot on the medial and one on the lateral side, moving backwards a little with flexion.",
        "A dark spot on the rim only, on one side only, or orange areas (overlap).",
        "Check cartilage and menisci in the label map; a one-sided contact may mean that the varus does not fit.",
    ),
    _contact,
)
CURVES = Figure(
    "curves",
    "Found coordinates against flexion",
    Caption(
        "The four coordinates that the program found: dots as found, lines after smoothing, one colour for each varus.",
        "Dots lie close to their line, and lines of neighbouring varus run side by side.",
        "Dots jump away from the line, lines cross wildly, crosses mark attitudes without a pose.",
        "Jumps come from rough surfaces: look at the contact picture there. Steep rotation: check the flexion axis.",
    ),
    _curves,
)
CHECKS = Figure(
    "checks",
    "Contact and repeatability against flexion",
    Caption(
        "What is left of gap or overlap after smoothing, the gap of each side, and way out against way back.",
        "Contact error within the dashed lines; at neutral varus both gaps are small; hysteresis near zero.",
        "Contact error beyond the dashed lines, one side wide open at every varus, hysteresis above 1 mm.",
        "Use a finer grid or a higher degree of smoothing where contact is lost; check the axes where a side is open.",
    ),
    _checks,
)


def expected_figures(evidence: Evidence) -> tuple[Figure, ...]:
    """The figures that the report of a case must have; slices where there is a CT or a label map to cut."""
    rest = (BONES, POSES, CONTACT, CURVES, CHECKS)
    return rest if evidence.labels is None and evidence.ct_cuts is None else (SLICES, *rest)


def drawn(figure: Figure, evidence: Evidence, settings: PictureSettings, limits: Limits) -> Drawn:
    """The figure, or why it cannot be drawn from this evidence (one the drawing refuses with ValueError)."""
    try:
        return Drawn(figure, figure.draw(evidence, settings, limits))
    except ValueError as error:
        return Drawn(figure, b"", str(error))
