"""Which label value of a file is which structure, and the number each structure has from then on."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StringConstraints

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.markups import snake_case
from pipeline.geometry.volume import LabelVolume, cropped
from pipeline.records import Side

#: How settings name a structure, and the values that a label may have.
StructureName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,63}$")]
LabelValue = Annotated[int, Field(ge=1, le=65_535)]

#: Ends of names that say of which side a structure is.
SIDE_ENDINGS = {"_right": "right", "_left": "left"}
#: Background kept around the labels, voxels: enough for a surface to close.
MARGIN_VOXELS = 2


def structure_values(
    segments: Mapping[str, int], declared: Mapping[str, int], wanted: Collection[str], file: str, side: Side
) -> tuple[dict[str, int], tuple[Finding, ...]]:
    """Structure name -> label value in the file: from the names of its segments, else as the case declares.

    Parameters
    ----------
    segments, declared : mapping of str to int
        Names and values in the file (empty where it has no names), and in the declaration of the case. A name may end
        in ``_right`` or ``_left``.
    wanted : collection of str
        Names of the structures that are used.
    file : str
        For messages.
    side : "right" or "left"
        Which of the names that end in a side are used.

    Raises
    ------
    CaseRejected
        E-LBL-03 when two structures share a value or two labels a name.
    """
    in_file, other_leg = _of_side(((snake_case(name), value) for name, value in segments.items()), wanted, side)
    if twice := _twice(in_file):
        problem = f"Two segments of {file} have the same name: {twice}."
        raise CaseRejected("E-LBL-03", problem, "Give each segment a name of its own.")
    named, other_declared = _of_side(declared.items(), wanted, side)
    if twice := _twice(named):
        problem = f"Two labels are declared for the same structure of the {side} leg: {twice}."
        raise CaseRejected("E-LBL-03", problem, "Give each structure one label value.")
    chosen, in_case = dict(in_file), dict(named)
    notes: tuple[Finding, ...] = ()
    if not chosen:
        chosen, other_leg = in_case, other_declared
    elif differing := sorted(name for name, value in chosen.items() if in_case.get(name, value) != value):
        text = f"The label values of {', '.join(differing)} are those that {file} itself names, not those declared."
        notes = (Finding("N-LBL-03", Severity.NOTE, text),)
    if other_leg:
        unused = f"Labels that are named for the other leg are not used: {', '.join(sorted(other_leg))}."
        notes = (*notes, Finding("N-LEG-02", Severity.NOTE, unused))
    values = list(chosen.values())
    if shared := sorted(name for name, value in chosen.items() if values.count(value) > 1):
        problem = f"Label {chosen[shared[0]]} is given to more than one structure of {file}: {', '.join(shared)}."
        raise CaseRejected("E-LBL-03", problem, "Give each structure a label value of its own.")
    return chosen, notes


def without_side(name: str) -> tuple[str, str | None]:
    """``femur_right`` -> ``femur`` and ``right``; the side is None for a name that ends in none."""
    for ending, side in SIDE_ENDINGS.items():
        if name.endswith(ending):
            return name.removesuffix(ending), side
    return name, None


def _of_side(
    named: Iterable[tuple[str, int]], wanted: Collection[str], side: Side
) -> tuple[list[tuple[str, int]], list[str]]:
    """The wanted structures of a side under their plain names, and the names of those of the other side."""
    kept: list[tuple[str, int]] = []
    other: list[str] = []
    for name, value in named:
        plain, of = (name, None) if name in wanted else without_side(name)
        if plain in wanted and of in (None, side):
            kept.append((plain, value))
        elif plain in wanted:
            other.append(name)
    return kept, other


def _twice(named: list[tuple[str, int]]) -> str:
    """The names that appear more than once, as a list in a sentence; empty where there are none."""
    names = [name for name, _ in named]
    return ", ".join(sorted({name for name in names if names.count(name) > 1}))


def number_structures(
    values: Mapping[str, int], counts: NDArray[np.int64], required: Collection[str], file: str
) -> dict[str, int]:
    """Structure name -> number in the canonical volume: those with voxels, in the order of their names, from 1.

    Parameters
    ----------
    values : mapping of str to int
        Structure name -> value in the file.
    counts : (N,) int
        Voxels of each value in the file.
    required : collection of str
        Structures without which there is no result.
    file : str
        For messages.

    Raises
    ------
    CaseRejected
        E-LBL-01 when a required structure has no voxels, or when none has.
    """
    present = ", ".join(map(str, np.flatnonzero(counts[1:]) + 1)) or "none"
    found = [name for name, value in sorted(values.items()) if value < len(counts) and counts[value] > 0]
    for name in required:
        if name not in values:
            problem = f"No label is declared as {name}; labels found in {file}: {present}."
            raise CaseRejected("E-LBL-01", problem, "Set 'labels:' in case.yaml.")
        if name not in found:
            problem = f"Label {values[name]} ({name}) is empty in {file}; labels found: {present}."
            raise CaseRejected("E-LBL-01", problem, "Set 'labels:' in case.yaml, or correct the segmentation.")
    if not found:
        problem = f"{file} holds none of the declared structures; labels found: {present}."
        raise CaseRejected("E-LBL-01", problem, "Set 'labels:' in case.yaml, or correct the segmentation.")
    return {name: number for number, name in enumerate(found, start=1)}


def renumbered(volume: LabelVolume, values: Mapping[str, int], structures: Mapping[str, int]) -> LabelVolume:
    """The volume with canonical numbers (uint8), cropped to the structures and MARGIN_VOXELS around them."""
    number_of = np.zeros(65_536, dtype=np.uint8)
    for name, number in structures.items():
        number_of[values[name]] = number
    return cropped(LabelVolume(number_of[np.asarray(volume.values)], volume.lps_from_index), MARGIN_VOXELS)
