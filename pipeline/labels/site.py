"""Labels by segmentation programs of the site: how a site names them, and their results as one label map."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, StringConstraints, model_validator

from pipeline.case_declaration import label_preset
from pipeline.engine.stage import Finding, Severity, StrictParams
from pipeline.errors import CaseRejected
from pipeline.geometry.volume import CtVolume, LabelVolume, cropped
from pipeline.labels.scheme import MARGIN_VOXELS, LabelValue, StructureName, structure_values, without_side
from pipeline.labels.taking import Progress, TakenLabels, take_labels
from pipeline.records import CaseFacts

if TYPE_CHECKING:
    from pipeline.files.volumes import LabelMap

#: Bones without which there is no knee.
REQUIRED = ("femur", "tibia")
#: What stands for the files and the side of a case in the words of a command.
PLACEHOLDERS = ("{ct}", "{labels}", "{side}")

Word = Annotated[str, StringConstraints(pattern=r"^[^\x00-\x1f\x7f]{1,1000}$")]
#: A name or a version, as findings show it.
Plain = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.+ -]{0,64}$")]


def _scheme(value: object) -> object:
    return label_preset(value) if isinstance(value, str) else value


class SiteCommand(StrictParams):
    """A segmentation program of the site."""

    command: tuple[Word, ...] = Field(min_length=1, max_length=100, description="program and arguments")
    labels: Annotated[dict[StructureName, LabelValue], BeforeValidator(_scheme)] = Field(
        min_length=1, max_length=30, description="name of a label scheme, or structure name -> value it writes"
    )
    name: Plain = Field("", description="what reports call it; else the name of the program")
    version: Plain = Field("", description="of the program; a new one makes labels anew")

    @model_validator(mode="after")
    def _placeholders_are_known(self) -> SiteCommand:
        used = {found for word in self.command for found in re.findall(r"\{[a-z]*\}", word)}
        if unknown := sorted(used - set(PLACEHOLDERS)):
            raise ValueError(f"{unknown[0]} stands for nothing; {', '.join(PLACEHOLDERS)} do")
        if missing := [needed for needed in PLACEHOLDERS[:2] if needed not in used]:
            raise ValueError(f"the command has no {missing[0]}")
        if any(placeholder in self.command[0] for placeholder in PLACEHOLDERS):
            raise ValueError("the program itself cannot depend on the case")
        return self

    @property
    def title(self) -> str:
        """What messages call it."""
        return f"{self.name or PurePath(self.command[0]).name} {self.version}".strip()

    @property
    def structures(self) -> frozenset[str]:
        """What it may find, without sides."""
        return frozenset(without_side(name)[0] for name in self.labels)


def named_twice(commands: Sequence[SiteCommand]) -> list[str]:
    """Structures that more than one command is to find."""
    every = [name for command in commands for name in command.structures]
    return sorted({name for name in every if every.count(name) > 1})


def labels_of_commands(
    ct: CtVolume, facts: CaseFacts, commands: Sequence[SiteCommand], limit_s: float, progress: Progress
) -> TakenLabels:
    """Run every command on the CT and take the labels of the declared leg.

    Parameters
    ----------
    ct : CtVolume
        Index axes near +L, +P, +S.
    facts : CaseFacts
    commands : sequence of SiteCommand
        Where two label the same voxel, the first one counts.
    limit_s : float
        For each command, seconds.
    progress : callable

    Raises
    ------
    EnvironmentFault
        E-SEG-02; see :func:`pipeline.adapters.site_command.label_map_of`.
    CaseRejected
        E-SEG-03 to E-SEG-06, E-IO-*, E-GEO-*, E-LBL-*; E-SEG-07 when a bone of the knee is not among the labels;
        those of :func:`pipeline.labels.taking.take_labels`.
    """
    from pipeline.adapters import site_command  # noqa: PLC0415 - nibabel, which a cached run must not pay for

    names = sorted(set[str]().union(*(command.structures for command in commands)))
    merged = _Merged(ct, {name: number for number, name in enumerate(names, start=1)})
    for done, command in enumerate(commands):
        progress(done, len(commands))
        call = site_command.CommandCall(command.command, command.title, limit_s)
        merged.add(site_command.label_map_of(call, ct, facts.side), command, facts)
    titles = tuple(dict.fromkeys(command.title for command in commands))
    volume, structures = merged.labels(" and ".join(titles))
    named = replace(facts, structures=structures, found_by=titles)
    taken = take_labels(volume, named, REQUIRED, f"the result of {' and '.join(titles)}", _unheard)
    return replace(taken, findings=(*merged.findings(), *taken.findings))


class _Merged:
    """Label maps of several commands on the grid of one CT."""

    def __init__(self, ct: CtVolume, numbers: Mapping[str, int]) -> None:
        self._ct = ct
        self._numbers = numbers
        self._values = np.zeros(ct.values.shape, dtype=np.uint8)
        self._overlap = 0
        self._told: list[Finding] = []

    def add(self, label_map: LabelMap, command: SiteCommand, facts: CaseFacts) -> None:
        """Fill what is free with the labels of one more command."""
        where = f"the label map of {command.title}"
        values, notes = structure_values(label_map.segments, command.labels, command.structures, where, facts.side)
        number_of = np.zeros(65_536, dtype=np.uint8)
        for name, value in values.items():
            number_of[value] = self._numbers[name]
        new: NDArray[np.uint8] = number_of[np.asarray(label_map.volume.values)]
        found = self._names_in(new)
        if not found:
            raise _not_found(f"{command.title} found none of {', '.join(sorted(values)) or 'its structures'}")
        self._overlap += int(np.count_nonzero((new > 0) & (self._values > 0)))
        np.copyto(self._values, new, where=self._values == 0)
        text = f"Found in the CT by {command.title}, a program of the site: {', '.join(found)}."
        self._told += [*label_map.findings, *notes, Finding("N-SEG-04", Severity.NOTE, text)]

    def labels(self, titles: str) -> tuple[LabelVolume, dict[str, int]]:
        """The labels, cropped, and the structures among them."""
        structures = {name: self._numbers[name] for name in self._names_in(self._values)}
        if missing := [name for name in REQUIRED if name not in structures]:
            raise _not_found(f"{titles} found no {' and no '.join(missing)}")
        return cropped(LabelVolume(self._values, self._ct.lps_from_index), MARGIN_VOXELS), structures

    def findings(self) -> Iterator[Finding]:
        """What the commands told, and how far they contradict one another."""
        yield from self._told
        if self._overlap:
            text = f"{self._overlap} voxels were labelled by more than one command; the first one's label was kept."
            yield Finding("N-SEG-05", Severity.NOTE, text)

    def _names_in(self, values: NDArray[np.uint8]) -> list[str]:
        there = np.bincount(values.ravel(), minlength=256)
        return [name for name, number in self._numbers.items() if there[number]]


def _not_found(problem: str) -> CaseRejected:
    action = "Check that this is the CT of the knee, and the side; else segment the bones and give a label map."
    return CaseRejected("E-SEG-07", f"{problem} in the CT.", action)


def _unheard(done: int, total: int) -> None:
    """Progress that nobody is told: the commands were nearly all of the work."""
