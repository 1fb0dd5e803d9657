"""Which label value of a file is which structure, and the number each structure has from then on."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.markups import snake_case
from pipeline.geometry.volume import LabelVolume, cropped

#: Background kept around the labels, voxels: enough for a surface to close.
MARGIN_VOXELS = 2


def structure_values(
    segments: Mapping[str, int], declared: Mapping[str, int], wanted: Collection[str], file: str
) -> tuple[dict[str, int], tuple[Finding, ...]]:
    """Structure name -> label value in the file: from the names of its segments, else as the case declares.

    Parameters
    ----------
    segments, declared : mapping of str to int
        Names and values in the file (empty where it has no names), and in the declaration of the case.
    wanted : collection of str
        Names of the structures that are used.
    file : str
        For messages.

    Raises
    ------
    CaseRejected
        E-LBL-03 when two structures share a value or two segments a name.
    """
    named = [(snake_case(name), value) for name, value in segments.items()]
    chosen = {name: value for name, value in named if name in wanted}
    if len(chosen) < sum(name in wanted for name, _ in named):
        problem = f"Two segments of {file} have the same name."
        raise CaseRejected("E-LBL-03", problem, "Give each segment a name of its own.")
    notes: tuple[Finding, ...] = ()
    if not chosen:
        chosen = {name: value for name, value in declared.items() if name in wanted}
    elif differing := sorted(name for name, value in chosen.items() if declared.get(name, value) != value):
        text = f"The label values of {', '.join(differing)} are those that {file} itself names, not those declared."
        notes = (Finding("N-LBL-03", Severity.NOTE, text),)
    values = list(chosen.values())
    if shared := sorted(name for name, value in chosen.items() if values.count(value) > 1):
        problem = f"Label {chosen[shared[0]]} is given to more than one structure of {file}: {', '.join(shared)}."
        raise CaseRejected("E-LBL-03", problem, "Give each structure a label value of its own.")
    return chosen, notes


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
