"""Stage intake, from files in a folder to the canonical case."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from pydantic import ValidationError
from pydicom import dcmread

from pipeline.artifacts import CT, GIVEN_FACTS, GIVEN_LABELS, GIVEN_MESHES, LIGAMENTS
from pipeline.engine.artifacts import SOURCE, Artifact, SourceFolder
from pipeline.engine.stage import Finding, Severity
from pipeline.errors import CaseRejected
from pipeline.files.dicom_writer import SeriesSpec, encode_series
from pipeline.files.meshes import encode_ply, encode_stl
from pipeline.files.nrrd_format import encode_nrrd
from pipeline.files.strict_yaml import parse_yaml
from pipeline.geometry.mesh import TriangleMesh
from pipeline.geometry.phantom import PHANTOM_LABELS
from pipeline.geometry.volume import CtVolume, LabelVolume
from pipeline.records import CaseFacts, LigamentFibre, Side
from pipeline.stages.intake import STAGE, Params
from tests.files.label_samples import knee_like, nifti_bytes, nrrd_bytes, restored, segment_keys
from tests.files.seg_samples import KNEE as SEG_KNEE
from tests.files.seg_samples import LEFT, SEGMENTS, SegSpec, seg_dataset
from tests.two_legs import leg, side_by_side, two_legs

T = TypeVar("T")

CHECKOUT = Path(__file__).resolve().parents[2]
DATA = CHECKOUT.parent / "shared/data"
PRESETS = sorted((CHECKOUT / "pipeline/configs/labels").glob("*.yaml"))
LABEL_VALUES = {"femur": 5, "tibia": 6, "femoral_cartilage": 1, "patella": 7}
PARAMS = Params(
    side="right", labels=LABEL_VALUES, required=["femur", "tibia"], optional=["femoral_cartilage", "medial_meniscus"]
)


class CaseInputs:
    """What the runner gives the first stage."""

    def __init__(self, folder: Path) -> None:
        files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        self.source = SourceFolder("P1", folder, {n: hashlib.sha256(d).hexdigest() for n, d in files.items()})

    def __getitem__(self, artifact: Artifact[T]) -> T:
        assert artifact is SOURCE
        return self.source  # type: ignore[return-value]


class CaseOutputs:
    """Encodes and decodes, as the store does."""

    jobs = 1

    def __init__(self) -> None:
        self.files: dict[str, Mapping[str, bytes]] = {}
        self.progressed: list[tuple[int, int]] = []

    def __setitem__(self, artifact: Artifact[T], value: T) -> None:
        self.files[artifact.name] = artifact.encode(value)

    def progress(self, done: int, total: int) -> None:
        self.progressed.append((done, total))

    def took(self, part: str, seconds: float) -> None:
        """Nobody asks how long it took."""

    def decoded(self, artifact: Artifact[T]) -> T:
        return artifact.decode(self.files[artifact.name])


class Result:
    def __init__(self, folder: Path, params: Params) -> None:
        self.out = CaseOutputs()
        self.findings: tuple[Finding, ...] = STAGE.run(CaseInputs(folder), params, self.out)
        assert set(self.out.files) == {artifact.name for artifact in STAGE.writes}

    @property
    def facts(self) -> CaseFacts:
        return self.out.decoded(GIVEN_FACTS)

    @property
    def volume(self) -> LabelVolume:
        volume = self.out.decoded(GIVEN_LABELS)
        assert volume is not None
        return volume

    def codes(self, severity: Severity) -> list[str]:
        return [finding.code for finding in self.findings if finding.severity == severity]


def run_on(folder: Path, volume: LabelVolume, params: Params = PARAMS) -> Result:
    (folder / "labels.nrrd").write_bytes(nrrd_bytes(volume))
    return Result(folder, params)


def edited(**changes: tuple[tuple[slice | int, slice | int, slice | int], int]) -> LabelVolume:
    """The knee with boxes of voxels set to a label."""
    knee = knee_like()
    values = np.array(knee.values)
    for box, label in changes.values():
        values[box] = label
    return LabelVolume(values, knee.lps_from_index)


def with_params(**changes: Any) -> Params:
    return Params(**(PARAMS.model_dump() | changes))


def refused(code: str, problem: str) -> pytest.RaisesExc[CaseRejected]:
    return pytest.raises(CaseRejected, match=f"^{code} .*{problem}")


def test_the_canonical_case(tmp_path: Path) -> None:
    result = run_on(tmp_path, knee_like())
    facts, volume = result.facts, result.volume
    assert (facts.case_id, facts.joint, facts.side, facts.source) == ("P1", "knee", "right", "labels")
    assert facts.structures == {"femoral_cartilage": 1, "femur": 2, "tibia": 3}
    assert facts.voxels == {"femoral_cartilage": 16 * 12 * 2, "femur": 16 * 12 * 10, "tibia": 14 * 12 * 10}
    assert list(facts.source_files) == ["labels.nrrd"]
    assert facts.shape == volume.values.shape == (16 + 4, 13 + 4, 24)  # the shafts reach both ends: no margin there
    np.testing.assert_allclose(facts.spacing_mm, (1.0, 1.5, 2.0))
    assert volume.values.dtype == np.uint8
    assert result.out.decoded(GIVEN_MESHES) == {}
    assert result.out.decoded(LIGAMENTS) == ()
    np.testing.assert_allclose(facts.clipped_mm2["femur"], 16 * 12 * 1.0 * 1.5)
    assert facts.clipped_mm2["femoral_cartilage"] == 0.0
    assert result.codes(Severity.NOTE) == ["N-LBL-01", "N-FOV-01", "N-FOV-01"]
    assert "not used: 7" in result.findings[0].message
    assert result.codes(Severity.REVIEW) == []
    assert result.out.progressed == [(0, 3), (1, 3), (2, 3)]


def test_the_same_case_in_other_files_is_the_same_case(tmp_path: Path) -> None:
    files = {
        "labels.nii.gz": nifti_bytes(restored(knee_like(), (0, 1, 2), (True, True, False))),
        "labels.nii": nifti_bytes(restored(knee_like(), (2, 0, 1), (True, False, False)), compressed=False),
        "labels.nrrd": nrrd_bytes(restored(knee_like(), (1, 0, 2), (False, False, False))),
        "s.seg.nrrd": nrrd_bytes(
            knee_like(), segment_keys({"Femur": 5, "Tibia": 6, "Femoral Cartilage": 1, "Patella": 7})
        ),
    }
    reference = run_on(tmp_path, knee_like())
    for number, (name, data) in enumerate(files.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / name).write_bytes(data)
        result = Result(folder, PARAMS)
        np.testing.assert_array_equal(result.volume.values, reference.volume.values)
        np.testing.assert_allclose(result.volume.lps_from_index, reference.volume.lps_from_index, atol=1e-4)
        assert result.facts.structures == reference.facts.structures


def test_the_same_bytes_each_time(tmp_path: Path) -> None:
    first, second = run_on(tmp_path, knee_like()), run_on(tmp_path, knee_like())
    assert first.out.files["given_labels"] == second.out.files["given_labels"]
    assert first.out.files["given_facts"] == second.out.files["given_facts"]


def test_the_side_is_never_guessed(tmp_path: Path) -> None:
    with refused("E-SIDE-01", "never guessed"):
        run_on(tmp_path, knee_like(), with_params(side=None))


@pytest.mark.fault("V13")
@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            {"labels": LABEL_VALUES | {"tibia": 9}},
            r"Label 9 \(tibia\) is empty in labels\.nrrd; labels found: 1, 5, 6, 7\.",
        ),
        ({"labels": {"femur": 5}}, r"No label is declared as tibia; labels found in labels\.nrrd: 1, 5, 6, 7\."),
        ({"required": [], "labels": {"femoral_cartilage": 9}}, "none of the declared structures"),
    ],
)
def test_missing_structures(changes: dict[str, Any], problem: str, tmp_path: Path) -> None:
    with refused("E-LBL-01", problem):
        run_on(tmp_path, knee_like(), with_params(**changes))


@pytest.mark.fault("V13")
def test_two_structures_with_one_value(tmp_path: Path) -> None:
    with refused("E-LBL-03", r"Label 5 is given to more than one structure of labels\.nrrd: femur, tibia"):
        run_on(tmp_path, knee_like(), with_params(labels={"femur": 5, "tibia": 5}))


def test_segment_names_decide_over_declared_values(tmp_path: Path) -> None:
    names = segment_keys({"femur": 6, "TIBIA": 5, "bed": 1})
    upside_down = LabelVolume(np.flip(np.asarray(knee_like().values), 2), knee_like().lps_from_index)
    (tmp_path / "labels.seg.nrrd").write_bytes(nrrd_bytes(upside_down, names))
    result = Result(tmp_path, PARAMS)
    assert result.facts.voxels == {"femur": 14 * 12 * 10, "tibia": 16 * 12 * 10}
    assert result.findings[0].code == "N-LBL-03"
    assert "femur, tibia" in result.findings[0].message


def test_segments_with_other_names_go_by_declared_values(tmp_path: Path) -> None:
    (tmp_path / "labels.seg.nrrd").write_bytes(nrrd_bytes(knee_like(), segment_keys({"Segment_1": 5, "Segment_2": 6})))
    assert set(Result(tmp_path, PARAMS).facts.structures) == {"femur", "tibia", "femoral_cartilage"}


def test_two_segments_of_one_name(tmp_path: Path) -> None:
    (tmp_path / "labels.seg.nrrd").write_bytes(nrrd_bytes(knee_like(), segment_keys({"Femur": 5, "femur ": 6})))
    with refused("E-(LBL-03|IO-13)", "labels.seg.nrrd"):
        Result(tmp_path, PARAMS)


@pytest.mark.fault("V14")
def test_femur_below_tibia(tmp_path: Path) -> None:
    with refused("E-LBL-06", "The femur lies 28 mm below the tibia"):
        run_on(tmp_path, knee_like(), with_params(labels={"femur": 6, "tibia": 5}))


@pytest.mark.fault("V14")
def test_femur_beside_tibia(tmp_path: Path) -> None:
    knee = knee_like()
    lying = np.array([[0, 0, 1.0, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]) @ knee.lps_from_index
    result = run_on(tmp_path, LabelVolume(knee.values, lying))
    assert "W-GEO-02" in result.codes(Severity.REVIEW)


@pytest.mark.fault("V14")
def test_two_femora(tmp_path: Path) -> None:
    with refused("E-LBL-07", "femur consists of 2 separate pieces"):
        run_on(tmp_path, edited(other=((slice(22, 26), slice(12, 20), slice(14, 24)), 5)))


@pytest.mark.parametrize("side", ["right", "left"])
def test_two_legs_in_one_label_map(tmp_path: Path, side: Side) -> None:
    every = dict(PHANTOM_LABELS)
    params = Params(side=side, labels=every, required=["femur", "tibia"], optional=sorted(every))
    two, one = run_on(tmp_path, two_legs(), params), run_on(tmp_path, leg(side), params)
    np.testing.assert_array_equal(two.volume.values, one.volume.values)
    assert two.facts.voxels == one.facts.voxels
    assert [code for code in two.codes(Severity.NOTE) if code not in one.codes(Severity.NOTE)] == ["N-LEG-01"]
    assert two.codes(Severity.REVIEW) == one.codes(Severity.REVIEW)


def test_two_legs_that_cannot_be_told_apart(tmp_path: Path) -> None:
    every = dict(PHANTOM_LABELS)
    params = Params(side="right", labels=every, required=["femur", "tibia"], optional=sorted(every))
    with refused("E-LEG-01", r"There seems to be more than one leg in labels\.nrrd, .*the fibula of the right leg"):
        run_on(tmp_path, side_by_side(leg("left"), leg("right")), params)


def test_a_declared_leg_without_a_required_structure(tmp_path: Path) -> None:
    params = Params(side="right", labels=dict(PHANTOM_LABELS), required=["femur", "tibia", "patella"], optional=[])
    values = np.array(leg("right").values)
    values[values == PHANTOM_LABELS["patella"]] = 0
    with refused("E-LBL-01", r"The right leg in labels\.nrrd has no patella\."):
        run_on(tmp_path, side_by_side(LabelVolume(values, leg("right").lps_from_index), leg("left")), params)


def test_values_that_are_named_for_a_side(tmp_path: Path) -> None:
    params = with_params(labels={"femur_right": 5, "femur_left": 9, "tibia": 6}, optional=[])
    result = run_on(tmp_path, knee_like(), params)
    assert result.facts.structures == {"femur": 1, "tibia": 2}
    assert "N-LEG-02" in result.codes(Severity.NOTE)
    with refused("E-LBL-01", r"Label 9 \(femur\) is empty in labels\.nrrd"):
        run_on(tmp_path, knee_like(), params.model_copy(update={"side": "left"}))


@pytest.mark.fault("V15")
def test_an_island_is_removed_and_named(tmp_path: Path) -> None:
    result = run_on(tmp_path, edited(island=((24, 20, slice(10, 13)), 5)))
    assert result.facts.voxels["femur"] == 16 * 12 * 10
    assert "1 islands of femur (3 voxels) were removed." in [finding.message for finding in result.findings]
    assert result.volume.values.shape == run_on(tmp_path, knee_like()).volume.values.shape


@pytest.mark.fault("V15")
def test_a_larger_island_is_looked_at(tmp_path: Path) -> None:
    result = run_on(tmp_path, edited(island=((slice(22, 25), slice(18, 20), slice(10, 18)), 5)))
    assert result.codes(Severity.REVIEW) == ["W-LBL-01"]
    assert result.facts.voxels["femur"] == 16 * 12 * 10


def test_cartilage_may_be_in_pieces(tmp_path: Path) -> None:
    result = run_on(tmp_path, edited(gap=((slice(10, 13), slice(0, 22), slice(12, 14)), 0)))
    assert result.facts.voxels["femoral_cartilage"] == 13 * 12 * 2
    assert result.codes(Severity.REVIEW) == ["W-LBL-01"]


@pytest.mark.fault("V15")
def test_cavities_are_filled(tmp_path: Path) -> None:
    result = run_on(tmp_path, edited(cavity=((10, 10, 18), 0)))
    assert result.facts.voxels["femur"] == 16 * 12 * 10
    assert "N-LBL-05" in result.codes(Severity.NOTE)
    large = run_on(tmp_path, edited(cavity=((slice(7, 11), slice(8, 12), slice(17, 21)), 0)))
    assert large.codes(Severity.REVIEW) == ["W-LBL-02"]


@pytest.mark.fault("V14")
def test_bones_that_touch(tmp_path: Path) -> None:
    result = run_on(tmp_path, edited(bridge=((slice(5, 12), slice(6, 12), slice(10, 14)), 6)))
    assert "W-LBL-03" in result.codes(Severity.REVIEW)


@pytest.mark.fault("V16")
def test_a_structure_cut_by_the_field_of_view(tmp_path: Path) -> None:
    result = run_on(tmp_path, edited(plate=((slice(0, 4), slice(5, 17), slice(12, 14)), 1)))
    clipped = [finding.message for finding in result.findings if finding.code == "W-FOV-01"]
    assert clipped == ["The field of view cuts femoral_cartilage over 72 mm2."]


@pytest.mark.fault("V16")
def test_a_bone_cut_on_a_second_side(tmp_path: Path) -> None:
    result = run_on(tmp_path, edited(spur=((slice(0, 4), slice(5, 17), slice(16, 18)), 5)))
    assert [f.message for f in result.findings if f.code == "W-FOV-01"] == [
        "The field of view cuts femur on more than one side (72 mm2 besides the shaft)."
    ]


@pytest.mark.fault("V17")
def test_thick_slices(tmp_path: Path) -> None:
    knee = knee_like()
    thick = LabelVolume(knee.values, knee.lps_from_index @ np.diag([1.0, 1.0, 2.4, 1.0]))
    assert run_on(tmp_path, thick).codes(Severity.REVIEW) == ["W-GEO-01"]


def test_landmarks_are_taken_along(tmp_path: Path) -> None:
    markup = {
        "type": "Fiducial",
        "coordinateSystem": "RAS",
        "controlPoints": [{"label": "Medial epicondyle", "position": [1.0, 2.0, 3.0]}],
    }
    document = {"@schema": "https://x/markups-schema-v1.0.3.json#", "markups": [markup]}
    (tmp_path / "landmarks.mrk.json").write_text(json.dumps(document))
    result = run_on(tmp_path, knee_like())
    assert result.facts.landmarks == {"medial_epicondyle": (-1.0, -2.0, 3.0)}
    assert sorted(result.facts.source_files) == ["labels.nrrd", "landmarks.mrk.json"]


LIGAMENT_TABLE = """name,reference_x,reference_y,reference_z,moving_x,moving_y,moving_z,slack_mm,kind
ACL,1,2,3,4,5,-30,,
PCL,5,10,0.1,6,12,-30,31.5,cord
"""


def test_ligaments_are_taken_along(tmp_path: Path) -> None:
    (tmp_path / "ligaments.csv").write_text(LIGAMENT_TABLE)
    result = run_on(tmp_path, knee_like())
    assert result.out.decoded(LIGAMENTS) == (
        LigamentFibre("ACL", (1.0, 2.0, 3.0), (4.0, 5.0, -30.0), None, 500.0),
        LigamentFibre("PCL", (5.0, 10.0, 0.1), (6.0, 12.0, -30.0), 31.5, None),
    )
    assert sorted(result.facts.source_files) == ["labels.nrrd", "ligaments.csv"]


def test_ligaments_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "ligaments.csv").write_text(LIGAMENT_TABLE.replace("31.5", "long"))
    with refused("E-LIG-02", r"Line 3 of ligaments\.csv is not a fibre: slack_mm is 'long'"):
        run_on(tmp_path, knee_like())


def tetrahedron() -> TriangleMesh:
    points = np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [0, 0, 30]])
    return TriangleMesh(points, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32))


def test_a_case_of_meshes(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/femur.ply").write_bytes(encode_ply(tetrahedron()))
    (tmp_path / "meshes/tibia.stl").write_bytes(encode_stl(tetrahedron()))
    (tmp_path / "meshes/screw.stl").write_bytes(b"never read")
    (tmp_path / "ligaments.csv").write_text(LIGAMENT_TABLE)
    result = Result(tmp_path, PARAMS)
    assert result.out.decoded(GIVEN_LABELS) is None
    meshes = result.out.decoded(GIVEN_MESHES)
    assert list(meshes) == ["femur", "tibia"]
    assert [fibre.name for fibre in result.out.decoded(LIGAMENTS)] == ["ACL", "PCL"]
    np.testing.assert_array_equal(meshes["femur"].points, tetrahedron().points)
    assert (result.facts.source, result.facts.structures) == ("meshes", {"femur": 0, "tibia": 0})
    assert [finding.message for finding in result.findings] == [
        "meshes/screw.stl is no structure of this joint; not used."
    ]


def test_a_case_of_too_few_meshes(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/femur.ply").write_bytes(encode_ply(tetrahedron()))
    with refused("E-LBL-01", "There is no mesh of tibia; meshes/ holds femur"):
        Result(tmp_path, PARAMS)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"side": "R"}, "side"),
        ({"labels": {"femur": 0}}, "greater than or equal to 1"),
        ({"labels": {"femur": 70_000}}, "less than or equal to 65535"),
        ({"labels": {"femur": "5"}}, "valid integer"),
        ({"labels": {"../femur": 5}}, "match pattern"),
        ({"required": ["Femur"]}, "match pattern"),
        ({"joint": "../knee"}, "match pattern"),
        ({"sides": "right"}, "Extra inputs"),
    ],
)
def test_settings_are_strict(changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        with_params(**changes)


@pytest.mark.parametrize("preset", PRESETS, ids=lambda path: path.stem)
def test_label_presets_are_valid_and_unambiguous(preset: Path) -> None:
    labels = parse_yaml(preset.read_bytes())
    assert Params.model_validate({"labels": labels}).labels == labels
    assert len(set(labels.values())) == len(labels)


@pytest.mark.skipif(not DATA.is_dir(), reason="real data not found beside the checkout")
@pytest.mark.parametrize("case", ["knee_mr_a", "knee_mr_b"])
def test_real_knees(case: str, tmp_path: Path) -> None:
    (tmp_path / "labels.nrrd").write_bytes((DATA / case / "labels.nrrd").read_bytes())
    labels = {str(name): int(str(value)) for name, value in parse_yaml(PRESETS[0].read_bytes()).items()}
    params = Params(side="right", labels=labels, required=["femur", "tibia"], optional=sorted(labels))
    result = Result(tmp_path, params)
    assert result.codes(Severity.REVIEW) == []
    assert {finding.code for finding in result.findings} == {"N-FOV-01"}
    assert len(result.facts.structures) == {"knee_mr_a": 10, "knee_mr_b": 7}[case]


def small_ct() -> CtVolume:
    """A block of bone in soft tissue in air, 40 x 36 x 30 mm."""
    values = np.full((40, 36, 30), -1000, dtype=np.int16)
    values[6:34, 6:30, :] = 40
    values[14:26, 12:24, 2:28] = 900
    return CtVolume(values, np.diag([1.0, 1.0, 1.0, 1.0]))


def test_a_dicom_series_without_labels_becomes_a_ct(tmp_path: Path) -> None:
    (tmp_path / "ct").mkdir()
    for name, data in encode_series(small_ct()).items():
        (tmp_path / "ct" / name).write_bytes(data)
    (tmp_path / "ct" / "Thumbs.db").write_bytes(b"not a slice")
    result = Result(tmp_path, PARAMS)
    assert result.facts.source == "ct"
    assert result.facts.structures == {}
    ct = result.out.decoded(CT)
    assert ct is not None
    np.testing.assert_array_equal(ct.values, small_ct().values)
    assert result.out.decoded(GIVEN_LABELS) is None
    (told,) = [finding for finding in result.findings if finding.code == "N-DCM-01"]
    assert "Thumbs.db" in told.message


def test_a_ct_beside_labels_is_kept_for_comparison(tmp_path: Path) -> None:
    (tmp_path / "ct.nrrd").write_bytes(encode_nrrd(small_ct()))
    result = run_on(tmp_path, knee_like())
    assert result.facts.source == "labels"
    assert result.out.decoded(CT) is not None


def test_a_ct_that_names_the_other_side_is_refused(tmp_path: Path) -> None:
    (tmp_path / "ct").mkdir()
    for name, data in encode_series(small_ct(), SeriesSpec(laterality="L")).items():
        (tmp_path / "ct" / name).write_bytes(data)
    with pytest.raises(CaseRejected, match="E-SIDE-03 The case is declared right, and every slice of the CT says left"):
        Result(tmp_path, PARAMS)


def test_two_cts_are_too_many(tmp_path: Path) -> None:
    (tmp_path / "ct").mkdir()
    (tmp_path / "ct" / "1.dcm").write_bytes(b"x")
    (tmp_path / "ct.nrrd").write_bytes(encode_nrrd(small_ct()))
    with pytest.raises(CaseRejected, match="E-IO-16 The case folder holds more than one CT"):
        Result(tmp_path, PARAMS)


def with_series(folder: Path) -> str:
    """A CT series in the case; its frame of reference."""
    (folder / "ct").mkdir()
    files = encode_series(small_ct())
    for name, data in files.items():
        (folder / "ct" / name).write_bytes(data)
    return str(dcmread(io.BytesIO(next(iter(files.values())))).FrameOfReferenceUID)


def with_segmentation(folder: Path, frame_uid: str, spec: SegSpec | None = None) -> None:
    """A DICOM segmentation beside it, of some frame of reference."""
    dataset = seg_dataset(SEG_KNEE, spec)
    dataset.FrameOfReferenceUID = frame_uid
    dataset.save_as(folder / "labels.dcm")


@pytest.mark.fault("V11")
def test_a_segmentation_of_another_frame_of_reference_is_refused(tmp_path: Path) -> None:
    with_segmentation(tmp_path, with_series(tmp_path))
    result = Result(tmp_path, PARAMS)
    assert result.facts.source == "labels"
    assert {"femur", "tibia", "femoral_cartilage"} <= result.facts.structures.keys()
    with_segmentation(tmp_path, "1.2.3.4.99")
    with refused("E-GEO-08", "labels.dcm does not belong to the CT of the case: it names another frame of reference"):
        Result(tmp_path, PARAMS)


@pytest.mark.fault("V18")
def test_a_segmentation_coded_as_the_other_side_is_refused(tmp_path: Path) -> None:
    left = SegSpec(segments=tuple(replace(one, modifiers=(LEFT,)) for one in SEGMENTS))
    with_segmentation(tmp_path, "1.2.3.4.99", left)
    with refused("E-SIDE-04", "The case is declared right, and the segments of labels.dcm are coded as left"):
        Result(tmp_path, PARAMS)
    assert Result(tmp_path, with_params(side="left")).facts.side == "left"


def test_a_list_of_checksums_is_no_slice_and_is_held_against_the_files(tmp_path: Path) -> None:
    with_series(tmp_path)
    files = sorted((tmp_path / "ct").iterdir())
    lines = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n" for file in files]
    (tmp_path / "ct" / "SHA256SUMS").write_text("".join(lines))
    (told,) = Result(tmp_path, PARAMS).findings
    assert told.message == f"{len(files)} files are as listed in ct/SHA256SUMS."
    files[-1].unlink()
    with refused("E-IO-31", "of 30 files listed in ct/SHA256SUMS are missing"):
        Result(tmp_path, PARAMS)
