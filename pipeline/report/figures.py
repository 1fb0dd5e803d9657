"""The pictures that a report must have, each with the four lines that tell a reader how to look at it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from pipeline.adapters.pictures import png
from pipeline.report.evidence import Evidence
from pipeline.report.figure_bones import bones_picture
from pipeline.report.figure_checks import checks_png, repeatability_known, repeats_png
from pipeline.report.figure_curves import curves_png
from pipeline.report.figure_neutral import baselines_png, neutral_png
from pipeline.report.figure_paths import paths_png
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
    """A picture of the report: file name without ending, title, caption, how it is drawn, and what the bytes are."""

    name: str
    title: str
    caption: Caption
    draw: Callable[[Evidence, PictureSettings, Limits], bytes]
    media: str = "image/png"

    @property
    def file(self) -> str:
        """Name of its file in the report, such as ``images/bones.png``."""
        return f"images/{self.name}.{self.media.rpartition('/')[2]}"


@dataclass(frozen=True)
class Drawn:
    """A figure and its bytes, or empty bytes and why there are none; how long it took is no part of the page."""

    figure: Figure
    data: bytes
    problem: str = ""
    seconds: float = field(default=0.0, compare=False)


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


def _neutral(evidence: Evidence, _: PictureSettings, __: Limits) -> bytes:
    return neutral_png(evidence)


def _baselines(evidence: Evidence, _: PictureSettings, limits: Limits) -> bytes:
    return baselines_png(evidence, limits)


def _paths(evidence: Evidence, _: PictureSettings, __: Limits) -> bytes:
    return paths_png(evidence)


def _repeats(evidence: Evidence, _: PictureSettings, __: Limits) -> bytes:
    return repeats_png(evidence)


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
NEUTRAL = Figure(
    "neutral",
    "At neutral varus, against published motion",
    Caption(
        "Each coordinate at neutral varus. Broken lines: simpler motions of these bones, through the pose of the scan. "
        "Green: how other people's knees, under other loads, change from extension on.",
        "Dots lie within a narrow blue band. The smoothed line a little below the dots of the proximal shift is usual.",
        "Grey zones or a wide band: the surfaces hold the joint loosely, the line is one of several possible poses.",
        "Never tune towards green: it is no target. Where an angle differs beyond the bar of its axes, check them.",
    ),
    _neutral,
)
BASELINES = Figure(
    "baselines",
    "What a motion costs that ignores the surfaces",
    Caption(
        "How far these bones overlap (-) or gape (+) along the push on a plain hinge, on a published average motion "
        "(both through the pose of the scan), and in this table.",
        "This table runs along zero, within its limits on the right, whatever the others do.",
        "This table leaves zero; or, with labelled cartilage, the hinge overlaps by over 1 mm at the scan itself.",
        "Overlap at the scan: look for labels that overlap. Steep walls of made menisci may overlap by 1 to 2 mm.",
    ),
    _baselines,
)
PATHS = Figure(
    "paths",
    "Where contact wanders on the joint surface",
    Caption(
        "Middle of the area of each side that touches or is at most 0.2 mm farther than its nearest point, at neutral "
        "varus, computed from the smoothed poses. Hollow: the side is open.",
        "Both paths lie on the joint surface and move on without leaps.",
        "Leaps between neighbours (often between the horns of a stiff meniscus), paths on a rim, many hollow points.",
        "Look at the contact picture at that flexion. With several spots of contact the middle may lie between them.",
    ),
    _paths,
)
CHECKS = Figure(
    "checks",
    "Contact against flexion",
    Caption(
        "Gap or overlap that smoothing leaves, at the entries of the table and between them, and the gap of each side.",
        "Contact within the dashed limits; at neutral varus both gaps are small.",
        "Contact beyond the dashed limits, or one side wide open at every varus.",
        "Use a finer grid or a higher degree of smoothing where contact is lost; check the axes where a side is open.",
    ),
    _checks,
)
REPEATS = Figure(
    "repeats",
    "How sure a pose is",
    Caption(
        "How bending and straightening differ, how the two solvers of this program differ, and how far a pose can be "
        "pushed before it slips (stability margin).",
        "Differences near zero, margins near the most that is tried.",
        "Differences of millimetres: two poses are equally good there. A margin near zero: a pose on an edge.",
        "Take the table there as one of several possible poses. Labelled menisci and ligaments hold a joint better.",
    ),
    _repeats,
)


def expected_figures(evidence: Evidence) -> tuple[Figure, ...]:
    """The figures that the report of a case must have.

    Slices where there is a CT or a label map to cut, baselines where the sweep was asked for them, and how sure a pose
    is where anything is known of it.
    """
    asked = {
        SLICES: evidence.labels is not None or evidence.ct_cuts is not None,
        BASELINES: bool(evidence.sweep.baselines),
        REPEATS: repeatability_known(evidence),
    }
    every = (SLICES, BONES, POSES, CONTACT, PATHS, CURVES, NEUTRAL, BASELINES, CHECKS, REPEATS)
    return tuple(figure for figure in every if asked.get(figure, True))


def drawn(figure: Figure, evidence: Evidence, settings: PictureSettings, limits: Limits) -> Drawn:
    """The figure, or why it cannot be drawn from this evidence (one the drawing refuses with ValueError)."""
    since = time.perf_counter()
    try:
        data, problem = figure.draw(evidence, settings, limits), ""
    except ValueError as error:
        data, problem = b"", str(error)
    return Drawn(figure, data, problem, time.perf_counter() - since)
