"""Labels of any origin on their way into the flow: one leg, cleaned, judged, and what is known of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.engine.stage import Finding, Findings, Severity
from pipeline.errors import CaseRejected
from pipeline.geometry.label_cleaning import LabelRepair, clean_label
from pipeline.geometry.two_legs import one_leg
from pipeline.geometry.volume import LabelVolume, border_areas_mm2, box_of, cropped
from pipeline.labels.review import (
    is_soft,
    review_anisotropy,
    review_clipping,
    review_order,
    review_pieces,
    review_touching,
)
from pipeline.labels.scheme import MARGIN_VOXELS
from pipeline.records import CaseFacts

#: What is told how much of the work is done: done, total.
Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class TakenLabels:
    """The labels of one leg, fit to be meshed.

    Attributes
    ----------
    volume : LabelVolume
        uint8, cropped to the structures and MARGIN_VOXELS around them.
    facts : CaseFacts
        Of the case, with what is known of its labels.
    findings : tuple of Finding
        What was changed or should be looked at.
    """

    volume: LabelVolume
    facts: CaseFacts
    findings: Findings


def take_labels(
    volume: LabelVolume, facts: CaseFacts, required: Collection[str], file: str, progress: Progress
) -> TakenLabels:
    """Take the declared leg, mend slips of the segmentation, and judge the rest.

    Parameters
    ----------
    volume : LabelVolume
        uint8, values of ``facts.structures``, each of which has voxels.
    facts : CaseFacts
        With the declared side and the structures; what is known of the labels besides is filled in.
    required : collection of str
        Structures without which there is no result.
    file : str
        For messages.
    progress : callable

    Raises
    ------
    CaseRejected
        E-LEG-01 when it cannot be told which of two legs is the declared one, E-LBL-01 when that lacks a required
        structure, E-LBL-06 when femur and tibia are upside down, E-LBL-07 when a bone is labelled twice.
    """
    volume, structures, told = _one_leg(volume, facts, required, file)
    volume, repairs = _cleaned(volume, structures, progress)
    return TakenLabels(
        volume,
        _with_labels(facts, volume, structures, repairs),
        (
            *told,
            *review_pieces(repairs, required, file),
            *review_order(volume, structures, file),
            *review_touching(volume, structures),
            *review_anisotropy(volume.spacing_mm),
            *(found for name in structures for found in review_clipping(name, _on_border(volume, structures[name]))),
        ),
    )


def _one_leg(
    volume: LabelVolume, facts: CaseFacts, required: Collection[str], file: str
) -> tuple[LabelVolume, dict[str, int], Findings]:
    """The labels of the declared leg, the structures that it has, and a note where there are two legs."""
    try:
        volume, left_out = one_leg(volume, facts.structures, facts.side)
    except ValueError as error:
        raise CaseRejected(
            "E-LEG-01",
            f"There seems to be more than one leg in {file}, and which is the {facts.side} one is not sure: {error}.",
            f"Check the side and the labels, and give a label map that holds the {facts.side} leg only.",
        ) from error
    if not left_out:
        return volume, facts.structures, ()
    present = set(np.unique(np.asarray(volume.values)).tolist())
    structures = {name: number for name, number in facts.structures.items() if number in present}
    if missing := [name for name in required if name not in structures]:
        problem = f"The {facts.side} leg in {file} has no {', '.join(missing)}."
        raise CaseRejected("E-LBL-01", problem, "Correct the segmentation of this leg, or check the side.")
    text = f"Two legs are in {file}; the {facts.side} one was taken. Left out of the other: {', '.join(left_out)}."
    return volume, structures, (Finding("N-LEG-01", Severity.NOTE, text),)


def _cleaned(
    volume: LabelVolume, structures: Mapping[str, int], progress: Progress
) -> tuple[LabelVolume, dict[str, LabelRepair]]:
    """Islands taken away and cavities filled, structure by structure."""
    values = np.array(volume.values)
    repairs: dict[str, LabelRepair] = {}
    for done, (name, number) in enumerate(structures.items()):
        progress(done, len(structures))
        box = box_of(values == number)
        part = values[box]
        mask, repairs[name] = clean_label(part == number, part == 0, one_piece=not is_soft(name))
        part[(part == number) & ~mask] = 0
        part[mask] = number
    # again, because an island may have held the volume open
    return cropped(LabelVolume(values, volume.lps_from_index), MARGIN_VOXELS), repairs


def _with_labels(
    facts: CaseFacts, volume: LabelVolume, structures: Mapping[str, int], repairs: Mapping[str, LabelRepair]
) -> CaseFacts:
    i, j, k = volume.values.shape
    x, y, z = map(float, volume.spacing_mm)
    return replace(
        facts,
        structures=dict(structures),
        voxels={name: repair.voxels for name, repair in repairs.items()},
        spacing_mm=(x, y, z),
        shape=(i, j, k),
        clipped_mm2={name: float(_on_border(volume, number).sum()) for name, number in structures.items()},
    )


def _on_border(volume: LabelVolume, number: int) -> NDArray[np.float64]:
    """(6,) area of one structure on each face of the volume; cropping kept the faces that labels touch."""
    return border_areas_mm2(np.asarray(volume.values) == number, volume.spacing_mm)
