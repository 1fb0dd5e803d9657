"""What a look at a case before it is processed has to say: facts to rows of a table, each with what to do next.

Nothing here reads a file; :mod:`pipeline.commands.quick_look` gathers the facts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected, ExitCode
from pipeline.geometry.cartilage import WIDEST_SPACE_MM
from pipeline.geometry.field_of_view import LEAST_BEYOND_MM, BoneExtent, KneeExtent, shaft_needed_mm
from pipeline.geometry.knee_side import SideSign
from pipeline.geometry.volume import axis_codes
from pipeline.missing_surfaces import MAKEABLE, Missing
from pipeline.records import Side
from pipeline.suggestions import listed, plain

Float = NDArray[np.float64]

#: Part of a message code -> what it is about.
_SUBJECTS = {
    "IO": "files",
    "DCM": "CT series",
    "GEO": "geometry",
    "CT": "CT numbers",
    "LBL": "labels",
    "LMK": "landmarks",
    "LIG": "ligaments",
    "MSH": "meshes",
    "SEG": "bones",
    "SIDE": "side",
    "FOV": "border",
}
#: Notes that a person should see before the run; all others are in the report.
_SHOWN_NOTES = ("N-SEG-02", "N-SEG-03", "N-LBL-06")
_SEE = "Look at it on the images before the case is processed; the report will ask the same."
_MORE_BONE = "Scan or export more of the {bone}, or give landmarks of its far end."
_PLANES = {"L": "sagittal", "R": "sagittal", "P": "coronal", "A": "coronal", "S": "axial", "I": "axial"}
_LANDMARKS = {"femur": ("femoral_head_centre", "femur_shaft_centre"), "tibia": ("ankle_centre", "tibia_shaft_centre")}
_WIDTH = 13


class State(StrEnum):
    """How one check ended."""

    OK = "OK"
    LOOK = "LOOK"
    STOP = "STOP"


@dataclass(frozen=True)
class Row:
    """One check.

    Attributes
    ----------
    title : str
        What was checked.
    found : str
        What was found, numbers with units.
    state : State
    action : str
        What to do next; empty where there is nothing to do.
    """

    title: str
    found: str
    state: State = State.OK
    action: str = ""


@dataclass(frozen=True, eq=False)
class SeriesFacts:
    """What the headers of a DICOM series say.

    Attributes
    ----------
    slices : int
    set_aside : tuple of (str, str)
        Files that are not part of it -> why.
    laterality : tuple of str
        Every different entry of the slices: ``R``, ``L``, others, or empty.
    thickness_mm, tilt_deg : float or None
        As declared.
    lps_from_index : (4, 4) float64 or None
        Columns, rows, slices; None where the slices are no even upright grid.
    """

    slices: int
    set_aside: tuple[tuple[str, str], ...]
    laterality: tuple[str, ...]
    thickness_mm: float | None
    tilt_deg: float | None
    lps_from_index: Float | None


@dataclass(frozen=True)
class Wanted:
    """What the settings want of a knee.

    Attributes
    ----------
    limit_deg : float or None
        Uncertainty of a long axis that asks for review; None where frames are given.
    landmarks : tuple of str
        Names of those that are given.
    surfaces : tuple of str
        Structures that make the contact bodies.
    missing : "make", "filler" or "leave"
        What is done about those that are not there.
    """

    limit_deg: float | None
    landmarks: tuple[str, ...]
    surfaces: tuple[str, ...]
    missing: Missing


def lines(row: Row) -> list[str]:
    """One line, and a second with what to do."""
    first = f"{row.state:<4}  {row.title:<{_WIDTH}} {row.found}"
    return [first, f"{'':<{_WIDTH + 6}} -> {row.action}"] if row.action else [first]


def closing(case_id: str, rows: Sequence[Row]) -> list[str]:
    """The last lines: what it comes to, and how far a quick look can be trusted."""
    states = [row.state for row in rows]
    if State.STOP in states:
        return [f"STOP  {case_id}: a run would refuse this case."]
    count = states.count(State.LOOK)
    told = f"{count} to look at" if count else "nothing speaks against processing it"
    word = State.LOOK if count else State.OK
    return [
        f"{word:<4}  {case_id}: {told}.",
        "This was a quick look on a coarse copy: the run looks closer and may still ask for review, or refuse.",
    ]


def exit_code(rows: Iterable[Row]) -> ExitCode:
    """10 where a run would refuse the case, 11 where there is something to look at, else 0."""
    states = {row.state for row in rows}
    return ExitCode.REJECTED if State.STOP in states else ExitCode.REVIEW if State.LOOK in states else ExitCode.PASS


def refusal_row(error: CaseRejected) -> Row:
    """The refusal that a run would end with."""
    return Row(_subject(error.code), f"{error.code}  {error.problem}", State.STOP, error.action)


def finding_rows(findings: Iterable[Finding]) -> Iterator[Row]:
    """What a stage found that a person should see."""
    for one in dict.fromkeys(findings):
        if one.severity is Severity.REVIEW:
            yield Row(_subject(one.code), f"{one.code}  {one.message}", State.LOOK, _SEE)
        elif one.code in _SHOWN_NOTES:
            yield Row(_subject(one.code), one.message)


def _subject(code: str) -> str:
    return _SUBJECTS.get(code.split("-")[1], "case")


def series_rows(facts: SeriesFacts, side: Side | None) -> Iterator[Row]:
    """What the headers show of a series that is one."""
    aside = [f"{name} ({why})" for name, why in facts.set_aside]
    more = f" and {len(aside) - 3} more" if len(aside) > 3 else ""
    left = f"; set aside: {', '.join(aside[:3])}{more}" if aside else "; no other files"
    yield Row("CT series", f"{facts.slices} slices of one series{left}")
    told = {"R": "right", "L": "left"}.get(facts.laterality[0]) if len(facts.laterality) == 1 else None
    if side is not None and told in (None, side):
        yield Row("side", f"{side}, as declared; " + (f"DICOM says {told}" if told else "DICOM does not say"))
    if facts.lps_from_index is not None:
        yield from _grid_rows(facts, facts.lps_from_index)


def _grid_rows(facts: SeriesFacts, matrix: Float) -> Iterator[Row]:
    gap = float(np.linalg.norm(matrix[:3, 2]))
    thick = "" if facts.thickness_mm is None else f"; {facts.thickness_mm:g} mm thick"
    yield Row("slice gaps", f"none missing, {gap:.4g} mm apart{thick}")
    declared = f" (the scanner's {facts.tilt_deg:g} deg are taken out)" if facts.tilt_deg else ""
    yield Row("gantry tilt", f"none in the slices{declared}")
    codes, normal = axis_codes(matrix), matrix[:3, 2] / gap
    off = math.degrees(math.acos(min(1.0, float(np.abs(normal).max()))))
    yield Row("orientation", f"{_PLANES[codes[2]]} slices, {off:.0f} deg oblique; stored as {codes}")


def volume_row(shape: Sequence[int], spacing_mm: Float) -> Row:
    """Voxels and range of a volume."""
    voxels = " x ".join(str(n) for n in shape)
    sizes = " x ".join(f"{step:.3g}" for step in spacing_mm)
    extent = " x ".join(f"{n * step:.0f}" for n, step in zip(shape, spacing_mm, strict=True))
    return Row("scan range", f"{extent} mm: {voxels} voxels of {sizes} mm")


def numbers_row(lowest: int, highest: int) -> Row:
    """CT numbers that passed their gate."""
    return Row("CT numbers", f"{lowest} to {highest} HU; bone is in it")


def metal_row(volume_mm3: float) -> Row:
    """Metal around the knee."""
    if volume_mm3 <= 0:
        return Row("metal", "none near the knee")
    found = f"{volume_mm3 / 1000:.2g} ml denser than bone near the knee"
    return Row("metal", found, State.LOOK, "Use a metal-artefact-reduced series if there is one; check the outlines.")


def unseen_row() -> Row:
    """No knee for this program, where programs of the site are to find the bones."""
    found = "this program's own look finds no knee of that side; the site's programs are asked in the run"
    return Row("bones", found, State.LOOK, "Check that this is the CT of the knee, and the side.")


def meshes_row() -> Row:
    """Bones that are given as meshes."""
    return Row("bones", "given as meshes: shafts, joint space and side are not looked at before the run")


def knee_rows(knee: KneeExtent, wanted: Wanted) -> Iterator[Row]:
    """Shafts and joint space."""
    yield _bone_row("femur", "above", knee.femur, wanted)
    yield _bone_row("tibia", "below", knee.tibia, wanted)
    yield _space_row(knee)


def _bone_row(bone: str, where: str, extent: BoneExtent, wanted: Wanted) -> Row:
    found = f"{extent.reach_mm:.0f} mm {where} the joint line, {extent.shaft_mm:.0f} mm of it shaft"
    action = _MORE_BONE.format(bone=bone)
    if wanted.limit_deg is None:
        return Row(bone, found)
    if extent.beyond_mm < LEAST_BEYOND_MM:
        short = f"only {extent.beyond_mm:.0f} mm beyond its widest part, expected at least {LEAST_BEYOND_MM:.0f} mm"
        return Row(bone, f"{found}; {short}", State.LOOK, f"A run would refuse this later. {action}")
    needed = shaft_needed_mm(wanted.limit_deg)
    if extent.shaft_mm < needed and not set(_LANDMARKS[bone]) & set(wanted.landmarks):
        return Row(bone, f"{found}; its axis is sure only from {needed:.0f} mm on", State.LOOK, action)
    return Row(bone, found)


def _space_row(knee: KneeExtent) -> Row:
    if math.isnan(knee.space_mm):
        problem = "femur and tibia do not lie over each other"
    else:
        problem = f"about {max(knee.space_mm, 0.0):.1f} mm at its narrowest, in layers of {knee.layer_mm:.1f} mm"
        if 0.0 < knee.space_mm <= WIDEST_SPACE_MM:
            return Row("joint space", problem)
    action = "Look whether the bones touch or the joint gapes: made cartilage has the protocol's thickness then."
    return Row("joint space", f"{problem}, which is none of a joint at rest", State.LOOK, action)


def side_row(signs: Sequence[SideSign], side: Side) -> Row:
    """Whether the anatomy is that of the declared side."""
    title = "side (bones)"
    against = [sign.sentence for sign in signs if not sign.agrees]
    if against:
        action = "Correct 'side:' in case.yaml, or check whether the images or labels are mirrored."
        return Row(title, f"declared {side}, but {against[0]}", State.LOOK, action)
    if not signs:
        action = "Check the side by eye: no fibula, menisci or tibial cartilage is there to tell it."
        return Row(title, f"declared {side}; nothing in the bones tells it", State.LOOK, action)
    return Row(title, f"{side} by its anatomy: {signs[0].sentence}")


def structures_rows(structures: Iterable[str], wanted: Wanted) -> Iterator[Row]:
    """What is there, and what takes the place of what is not."""
    there = tuple(structures)
    yield Row("structures", _words(there))
    missing = [name for name in wanted.surfaces if name not in there]
    if not missing:
        return
    made = [name for name in missing if name in MAKEABLE]
    if wanted.missing == "leave" or not made:
        action = "Label them, or set contact.missing_surfaces to make."
        yield Row("not there", f"{_words(missing)}; the bones meet without them", State.LOOK, action)
    else:
        how = "made from the bones" if wanted.missing == "make" else "one filler of the joint space in their place"
        yield Row("not there", f"{_words(made)}; {how}, not seen in the scan")


def _words(names: Iterable[str]) -> str:
    return listed(plain(name) for name in names)
