"""Stage 10, intake: foreign files become one canonical label volume (or named meshes) in LPS, or are refused.

Foreign bytes are read in a sealed process; only what a site's own program leaves is read by the next stage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from pydantic import Field

from pipeline.artifacts import CT, GIVEN_FACTS, GIVEN_LABELS, GIVEN_MESHES, LIGAMENTS
from pipeline.engine.artifacts import SOURCE, SourceFolder
from pipeline.engine.stage import Finding, Findings, Inputs, Limits, Outputs, Severity, Stage, StrictParams
from pipeline.errors import CaseRejected
from pipeline.files.case_files import CT_FOLDER, CaseFiles, choose_files, read_file
from pipeline.files.checksums import check_checksums
from pipeline.files.ct_volumes import CtScan, read_ct_volume
from pipeline.files.ligaments_file import read_ligaments
from pipeline.files.markups import read_markups
from pipeline.files.meshes import read_mesh
from pipeline.files.volumes import LabelMap, check_belongs, read_label_map
from pipeline.geometry.mesh import TriangleMesh
from pipeline.labels.review import review_unused
from pipeline.labels.scheme import LabelValue, StructureName, number_structures, renumbered, structure_values
from pipeline.labels.taking import take_labels
from pipeline.records import CaseFacts, LigamentFibre, Side


class Params(StrictParams):
    """What the case declares about itself, and what its joint needs."""

    joint: str = Field(default="knee", pattern=r"^[a-z][a-z0-9_-]{0,63}$", description="name of the joint file")
    side: Side | None = Field(default=None, description="side of the body; never guessed")
    labels: dict[StructureName, LabelValue] = Field(
        default_factory=dict, max_length=255, description="structure name -> value in the label map"
    )
    required: list[StructureName] = Field(
        default_factory=list, max_length=255, description="structures without which there is no result"
    )
    optional: list[StructureName] = Field(
        default_factory=list, max_length=255, description="structures that are used where they are labelled"
    )

    @property
    def wanted(self) -> frozenset[str]:
        """Structures that are used where present."""
        return frozenset((*self.required, *self.optional))


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Read the case, check it, and leave its canonical form.

    Raises
    ------
    CaseRejected
        E-SIDE-*, E-IO-*, E-GEO-*, E-LBL-*, E-LMK-*, E-LIG-*; see ``docs/messages.md``.
    """
    source = reads[SOURCE]
    side = _declared_side(params)
    files = choose_files(source.files)
    seen = check_checksums(source.files, {name: read_file(source, name) for name in files.checksums})
    facts = _common_facts(source, files, params, side)
    out[LIGAMENTS] = _ligaments(source, files.ligaments)
    scan = _ct(source, files.ct, side)
    out[CT] = None if scan is None else scan.volume
    seen += () if scan is None else scan.findings
    if files.label_map is not None:
        label_map = read_label_map(read_file(source, files.label_map), files.label_map)
        check_belongs(label_map, files.label_map, side, "" if scan is None else scan.frame_of_reference)
        return seen + _take_labels(label_map, files.label_map, params, facts, out)
    out[GIVEN_LABELS] = None
    if files.meshes:
        meshes, findings = _given_meshes(source, files.meshes, params, out)
        out[GIVEN_FACTS], out[GIVEN_MESHES] = _facts_of_meshes(facts, meshes), meshes
        return seen + findings
    out[GIVEN_FACTS], out[GIVEN_MESHES] = facts, {}
    return seen


_LEAVES = (GIVEN_FACTS, GIVEN_LABELS, CT, GIVEN_MESHES, LIGAMENTS)
STAGE = Stage(10, "intake", (SOURCE,), _LEAVES, Params, run, limits=Limits())


def _declared_side(params: Params) -> Side:
    if params.side is None:
        raise CaseRejected(
            "E-SIDE-01",
            "The side of the body is not given with the case; it is never guessed.",
            "Write 'side: right' or 'side: left' in case.yaml.",
        )
    return params.side


def _common_facts(source: SourceFolder, files: CaseFiles, params: Params, side: Side) -> CaseFacts:
    """What holds for either kind of case; everything about labels is still empty."""
    landmarks = files.landmarks
    return CaseFacts(
        case_id=source.case_id,
        joint=params.joint,
        side=side,
        source="labels" if files.label_map else "meshes" if files.meshes else "ct",
        source_files={name: source.files[name] for name in files.names},
        structures={},
        voxels={},
        spacing_mm=(0.0, 0.0, 0.0),
        shape=(0, 0, 0),
        clipped_mm2={},
        landmarks={} if landmarks is None else read_markups(read_file(source, landmarks), landmarks),
    )


def _ct(source: SourceFolder, names: tuple[str, ...], side: Side) -> CtScan | None:
    """The CT of the case.

    Raises
    ------
    CaseRejected
        E-SIDE-03 where its files name the other side; E-DCM-*, E-CT-*, E-IO-*, E-GEO-*.
    """
    if not names:
        return None
    if names[0].startswith(CT_FOLDER):
        from pipeline.files.dicom_series import read_dicom_series  # noqa: PLC0415 - pydicom, not for a cached run

        scan = read_dicom_series(names, partial(read_file, source))
    else:
        scan = read_ct_volume(read_file(source, names[0]), names[0])
    if scan.laterality not in (None, side):
        raise CaseRejected(
            "E-SIDE-03",
            f"The case is declared {side}, and every slice of the CT says {scan.laterality}.",
            "Correct 'side:' in case.yaml, or give the CT of the other leg.",
        )
    return scan


def _ligaments(source: SourceFolder, file: str | None) -> tuple[LigamentFibre, ...]:
    return () if file is None else read_ligaments(read_file(source, file), file)


def _given_meshes(
    source: SourceFolder, files: Mapping[str, str], params: Params, out: Outputs
) -> tuple[dict[str, TriangleMesh], Findings]:
    """The wanted meshes by structure name."""
    if missing := [name for name in params.required if name not in files]:
        problem = f"There is no mesh of {missing[0]}; meshes/ holds {', '.join(sorted(files))}."
        raise CaseRejected("E-LBL-01", problem, f"Put it there as meshes/{missing[0]}.ply or .stl.")
    meshes: dict[str, TriangleMesh] = {}
    findings: list[Finding] = []
    for done, (name, file) in enumerate(sorted(files.items())):
        out.progress(done, len(files))
        if name not in params.wanted:
            findings.append(Finding("N-LBL-01", Severity.NOTE, f"{file} is no structure of this joint; not used."))
            continue
        given = read_mesh(read_file(source, file), file)
        meshes[name] = given.mesh
        findings += given.findings
    return meshes, tuple(findings)


def _facts_of_meshes(facts: CaseFacts, meshes: Mapping[str, TriangleMesh]) -> CaseFacts:
    return replace(
        facts,
        structures=dict.fromkeys(meshes, 0),
        voxels=dict.fromkeys(meshes, 0),
        clipped_mm2=dict.fromkeys(meshes, 0.0),
    )


def _take_labels(label_map: LabelMap, file: str, params: Params, facts: CaseFacts, out: Outputs) -> Findings:
    """Map, clean and judge the labels; leave the three artifacts."""
    values, notes = structure_values(label_map.segments, params.labels, params.wanted, file, facts.side)
    structures = number_structures(values, label_map.counts, params.required, file)
    volume = renumbered(label_map.volume, values, structures)
    taken = take_labels(volume, replace(facts, structures=structures), params.required, file, out.progress)
    out[GIVEN_FACTS], out[GIVEN_LABELS], out[GIVEN_MESHES] = taken.facts, taken.volume, {}
    used = [values[name] for name in structures]
    return (*label_map.findings, *notes, *review_unused(label_map.counts, used, file), *taken.findings)
