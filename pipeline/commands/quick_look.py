"""A look at a case before it is processed: nothing is written, no surface is made.

The stages ``intake`` and ``segment`` themselves judge, in memory: what they refuse is told in their words. Of a CT
without labels ``segment`` sees a coarse copy; where it finds no knee there, it is asked again with the CT itself, so
that a stop is always one of a run. The other way round a run may refuse what was well here: its stages after
``segment`` are not asked (too little shaft, no joint space), nor are segmentation programs of the site; and a bone that
has a clear boundary in the coarse copy could have none in the CT.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar, cast

import numpy as np

from pipeline.artifacts import CASE_FACTS, CT, GIVEN_FACTS, GIVEN_LABELS, LABELS
from pipeline.commands.preflight import (
    Row,
    SeriesFacts,
    Wanted,
    finding_rows,
    knee_rows,
    meshes_row,
    metal_row,
    numbers_row,
    refusal_row,
    series_rows,
    side_row,
    structures_rows,
    unseen_row,
    volume_row,
)
from pipeline.commands.request import Request
from pipeline.engine.artifacts import SOURCE, Artifact, SourceFolder
from pipeline.engine.confinement import Channel, Confinement, Made, confined
from pipeline.engine.exchange import WatchedFolder
from pipeline.engine.records import record_artifact
from pipeline.engine.source import list_source
from pipeline.engine.stage import Findings, StrictParams
from pipeline.errors import CaseRejected
from pipeline.files.case_files import CT_FOLDER, choose_files, read_file
from pipeline.geometry.field_of_view import coarse_copy, knee_extent, metal_mm3, side_signs
from pipeline.geometry.volume import CtVolume, LabelVolume, border_areas_mm2
from pipeline.labels.review import review_anisotropy, review_clipping
from pipeline.records import CaseFacts, Side
from pipeline.stages import anatomy, contact, intake, segment

T = TypeVar("T")
Settings = Mapping[str, StrictParams]

_ROWS = record_artifact("rows", "rows.json", tuple[Row, ...])
#: Voxel size of the copy in which the bones are looked for.
LOOK_MM = 2.0
#: What a coarse copy cannot tell: how surely bones were found, and small metal.
_TOO_COARSE_FOR = frozenset(("N-SEG-01", "W-SEG-01", "W-SEG-02"))


@dataclass
class _Desk:
    """Where a stage finds what it reads and leaves what it makes, as it is; nothing goes to disk."""

    held: dict[str, Any] = field(default_factory=dict)
    jobs: int = 1

    def __getitem__(self, artifact: Artifact[T]) -> T:
        return cast("T", self.held[artifact.name])

    def __setitem__(self, artifact: Artifact[T], value: T) -> None:
        self.held[artifact.name] = value

    def progress(self, done: int, total: int) -> None:
        """Nobody waits for it."""

    def took(self, part: str, seconds: float) -> None:
        """Nobody asks how long it took."""


def examine(request: Request, settings: Settings) -> tuple[Row, ...]:
    """Every check of a case, in order; a refusal is the last one.

    Foreign bytes are read in a sealed child process with the limits of stage ``intake``.

    Parameters
    ----------
    request : Request
    settings : mapping of str to StrictParams
        Of the whole flow.

    Raises
    ------
    EnvironmentFault
        When the disk fails.
    """
    try:
        return _sealed(list_source(request.case_id, request.job().source), settings)
    except CaseRejected as error:
        return (refusal_row(error),)


def _sealed(source: SourceFolder, settings: Settings) -> tuple[Row, ...]:
    def work(channel: Channel) -> Made:
        watched = WatchedFolder(source.case_id, source.root, source.files, channel.opened)
        return Made((), {_ROWS.name: _ROWS.encode(tuple(_rows(watched, settings)))})

    stage = replace(intake.STAGE, name="check", writes=(_ROWS,))
    with confined(Confinement(stage, (source.root,), source.files, _unheard, _unheard), work) as result:
        return _ROWS.decode(result().held[_ROWS.name])


def _unheard(*_: object) -> None:
    """Neither progress nor what the system cannot seal is told: the run tells it."""


def _rows(source: SourceFolder, settings: Settings) -> Iterator[Row]:
    params = cast("intake.Params", settings["intake"])
    desk = _Desk({SOURCE.name: source})
    try:
        yield from _headers(source, params.side)
        findings = intake.run(desk, params, desk)
        yield from _volumes(desk)
        yield from finding_rows(findings)
        yield from _bones(desk, settings)
    except CaseRejected as error:
        yield refusal_row(error)


def _headers(source: SourceFolder, side: Side | None) -> Iterator[Row]:
    """What the headers of a DICOM series tell; what is wrong with them is for intake to say."""
    with suppress(CaseRejected):
        names = [name for name in choose_files(source.files).ct if name.startswith(CT_FOLDER)]
        if names:
            yield from series_rows(_series(source, names), side)


def _series(source: SourceFolder, names: list[str]) -> SeriesFacts:
    from pipeline.files.dicom_headers import DicomHeader, read_header  # noqa: PLC0415 - pydicom, for DICOM cases only
    from pipeline.files.dicom_series import choose_series  # noqa: PLC0415 - as above
    from pipeline.files.dicom_stack import check_stack  # noqa: PLC0415 - as above

    read = partial(read_file, source)
    found = [read_header(read(name), name) for name in names]
    headers = [header for header in found if isinstance(header, DicomHeader)]
    chosen = choose_series(headers)
    matrix = None
    with suppress(CaseRejected):
        matrix = check_stack(chosen.slices).lps_from_index
    slices = {header.file for header in chosen.slices}
    reasons = dict(chosen.set_aside)
    aside = tuple((name, reasons.get(name, "not a CT image")) for name in names if name not in slices)
    first = chosen.slices[0]
    sides = tuple(sorted({header.laterality for header in chosen.slices}))
    return SeriesFacts(len(slices), aside, sides, first.slice_thickness_mm, first.tilt_deg, matrix)


def _volumes(desk: _Desk) -> Iterator[Row]:
    ct, labels = desk[CT], desk[GIVEN_LABELS]
    volume = ct or labels
    if volume is not None:
        yield volume_row(volume.values.shape, volume.spacing_mm)
    if ct is not None:
        yield numbers_row(int(ct.values.min()), int(ct.values.max()))
        yield from finding_rows(review_anisotropy(ct.spacing_mm))


def _bones(desk: _Desk, settings: Settings) -> Iterator[Row]:
    """What is seen of the joint itself."""
    params = cast("segment.Params", settings["segment"])
    try:
        desk, findings = _found(desk, params)
    except CaseRejected:
        if not params.commands or desk[GIVEN_FACTS].source != "ct":
            raise
        yield unseen_row()
        return
    yield from finding_rows(findings)
    facts, labels, ct = desk[CASE_FACTS], desk[LABELS], desk[CT]
    wanted = _wanted(facts, settings)
    if labels is None:
        yield meshes_row()
    else:
        yield from _knee(facts, labels, wanted)
    if ct is not None and labels is not None:
        yield from _scan(facts, labels, ct)
    yield from structures_rows(facts.structures, wanted)


def _found(desk: _Desk, params: segment.Params) -> tuple[_Desk, Findings]:
    """The bones as given, or in a coarse copy; the CT itself is asked before a stop, and a site's programs never."""
    own, ct = params.model_copy(update={"commands": ()}), desk[CT]
    if desk[GIVEN_FACTS].source != "ct" or ct is None:
        return desk, segment.run(desk, own, desk)
    quick = _Desk({**desk.held, CT.name: coarse_copy(ct, LOOK_MM)})
    try:
        findings = segment.run(quick, own, quick)
    except CaseRejected:
        return desk, segment.run(desk, own, desk)
    quick[CT] = ct
    return quick, tuple(one for one in findings if one.code not in _TOO_COARSE_FOR)


def _wanted(facts: CaseFacts, settings: Settings) -> Wanted:
    frames = cast("anatomy.Params", settings["anatomy"])
    bodies = cast("contact.Params", settings["contact"])
    return Wanted(
        limit_deg=frames.max_long_axis_uncertainty_deg if frames.method == "knee" else None,
        landmarks=tuple(facts.landmarks),
        surfaces=(*bodies.reference, *bodies.moving),
        missing=bodies.missing_surfaces,
    )


def _knee(facts: CaseFacts, labels: LabelVolume, wanted: Wanted) -> Iterator[Row]:
    if {"femur", "tibia"} <= facts.structures.keys():
        yield from knee_rows(knee_extent(labels, facts.structures["femur"], facts.structures["tibia"]), wanted)
        yield side_row(side_signs(labels, facts.structures, facts.side), facts.side)


def _scan(facts: CaseFacts, labels: LabelVolume, ct: CtVolume) -> Iterator[Row]:
    """What the CT shows around the bones."""
    from pipeline.geometry.bone_parts import METAL_HU  # noqa: PLC0415 - scipy, which segment has loaded for a CT only

    if facts.source == "ct":
        values = np.asarray(labels.values)
        for name, number in facts.structures.items():
            yield from finding_rows(review_clipping(name, border_areas_mm2(values == number, labels.spacing_mm)))
    yield metal_row(metal_mm3(ct, labels, METAL_HU))
