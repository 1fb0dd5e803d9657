"""Which files of a case are read."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from pipeline.engine.artifacts import SourceFolder
from pipeline.errors import CaseRejected
from pipeline.files import case_files
from pipeline.files.case_files import choose_files, read_file

OTHERS = ["case.yaml", "labels.json", "notes/labels.nrrd", "scout.dcm", "meshes/readme.txt", "ctlike.nii.gz"]


@pytest.mark.parametrize(
    "name",
    [
        "labels.nii.gz",
        "labels.nii",
        "labels.nrrd",
        "LABELS.MHA",
        "labels.seg.nrrd",
        "P1.seg.nrrd",
        "labels.dcm",
        "P1.SEG.dcm",
    ],
)
def test_one_label_map(name: str) -> None:
    chosen = choose_files([*OTHERS, name])
    assert (chosen.label_map, dict(chosen.meshes), chosen.landmarks, chosen.ligaments) == (name, {}, None, None)
    assert chosen.names == (name,)


@pytest.mark.parametrize("names", [["ct/2.dcm", "ct/1", "ct/more/3"], ["ct.nii.gz"], ["CT.nrrd"], ["ct.mha"]])
@pytest.mark.parametrize("labels", [[], ["labels.nrrd"]])
def test_a_ct_alone_or_beside_labels(names: list[str], labels: list[str]) -> None:
    chosen = choose_files(["case.yaml", *names, *labels])
    assert chosen.ct == tuple(sorted(names))
    assert chosen.label_map == (labels[0] if labels else None)
    assert set(chosen.names) == {*names, *labels}


def test_meshes_and_landmarks() -> None:
    chosen = choose_files(["meshes/tibia.stl", "meshes/femur.ply", "landmarks.mrk.json", "case.yaml"])
    assert chosen.label_map is None
    assert dict(chosen.meshes) == {"femur": "meshes/femur.ply", "tibia": "meshes/tibia.stl"}
    assert chosen.names == ("meshes/femur.ply", "meshes/tibia.stl", "landmarks.mrk.json")


@pytest.mark.parametrize("name", ["ligaments.csv", "Ligaments.CSV"])
def test_ligaments(name: str) -> None:
    chosen = choose_files(["labels.nrrd", name, "old_ligaments.csv", "notes/ligaments.csv", "lut.csv"])
    assert chosen.ligaments == name
    assert chosen.names == ("labels.nrrd", name)


@pytest.mark.fault("V02")
@pytest.mark.parametrize(
    ("names", "code", "problem"),
    [
        (OTHERS, "E-IO-15", r"holds neither a CT nor a label map; it holds case.yaml, ctlike.nii.gz, labels.json"),
        (["ct/1.dcm", "ct.nrrd"], "E-IO-16", r"more than one CT: ct\.nrrd, ct/"),
        (["ct.nii.gz", "CT.MHA"], "E-IO-16", r"more than one CT: CT\.MHA, ct\.nii\.gz"),
        ([], "E-IO-15", "no files"),
        (["labels.nii", "labels.nii.gz"], "E-IO-16", r"more than one segmentation: labels\.nii, labels\.nii\.gz"),
        (["labels.nii", "a.seg.dcm"], "E-IO-16", r"a\.seg\.dcm, labels\.nii"),
        (["labels.nii", "a.seg.nrrd"], "E-IO-16", r"a\.seg\.nrrd, labels\.nii"),
        (["labels.nii", "meshes/femur.ply"], "E-IO-16", r"labels\.nii, meshes/femur\.ply"),
        (["labels.nii", "a.fcsv", "b.mrk.json"], "E-IO-16", r"landmark file: a\.fcsv, b\.mrk\.json"),
        (["labels.nii", "ligaments.csv", "Ligaments.csv"], "E-IO-16", r"ligament file: Ligaments\.csv, ligaments\.csv"),
        (["meshes/femur.ply", "meshes/femur.stl"], "E-IO-16", "mesh of one structure"),
    ],
)
def test_no_choice_is_made_in_doubt(names: list[str], code: str, problem: str) -> None:
    with pytest.raises(CaseRejected, match=f"^{code} .*{problem}"):
        choose_files(names)


def source(folder: Path, content: bytes) -> SourceFolder:
    (folder / "labels.nii").write_bytes(content)
    return SourceFolder("P1", folder, {"labels.nii": hashlib.sha256(content).hexdigest()})


def test_a_file_that_is_still_being_copied(tmp_path: Path) -> None:
    listed = source(tmp_path, b"half")
    assert read_file(listed, "labels.nii") == b"half"
    (tmp_path / "labels.nii").write_bytes(b"half and half")
    with pytest.raises(CaseRejected, match=r"^E-IO-17 labels\.nii changed"):
        read_file(listed, "labels.nii")


def test_a_file_that_is_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(case_files, "MAX_FILE_BYTES", 3)
    with pytest.raises(CaseRejected, match=r"^E-IO-14 labels\.nii has"):
        read_file(source(tmp_path, b"four"), "labels.nii")
