"""A finished case as DICOM objects: asked for by name, of the right case or not at all, and clean to a validator.

``dciodvfy`` is no dependency of this project; Debian's package dicom3tools has it (``make test-exports`` installs it
where it may).
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydicom import dcmread

from pipeline import cli
from pipeline.adapters.pictures import png
from pipeline.commands.dicom_export import dicom_files
from pipeline.errors import CaseRejected, ConfigError, ExitCode
from pipeline.exports import FORMATS
from pipeline.files.lut_file import encode_lut
from pipeline.files.meshes import encode_ply
from pipeline.files.nrrd_format import encode_nrrd
from tests.exports.test_agreement import source
from tests.files.dicom_samples import Files, leg
from tests.files.test_dicom_report import NAMES, PDF, captures, named, report, study_of, with_identity

PICTURE = np.random.default_rng(3).integers(0, 256, (40, 60, 3), dtype=np.uint8)
DCIODVFY = shutil.which("dciodvfy")
Make = Callable[..., None]


def case_files(ct: Files) -> Files:
    return {**{f"ct/{name}": data for name, data in ct.items()}, "case.yaml": b"side: left\n"}


def package_of(case: Files, files: Files) -> Files:
    """A package of such a case, as far as the archive is concerned."""
    sample = source("left")
    surfaces = [{"structure": name, "body": body, "origin": "labelled"} for name, body in sample.bodies.items()]
    meshes = {f"meshes/{name}.ply": encode_ply(mesh) for name, mesh in sample.structures.items()}
    files = {"lut.h5": encode_lut(sample.content), **meshes, **files}
    manifest = {
        "joint": "knee",
        "side": "left",
        "verdict": {"word": "PASS"},
        "surfaces": surfaces,
        "sources_sha256": sorted(sha256(data) for name, data in case.items() if name != "case.yaml"),
        "files": {name: {"sha256": sha256(data)} for name, data in files.items()},
    }
    return {**files, "manifest.json": json.dumps(manifest).encode()}


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def write(folder: Path, files: Files) -> None:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def written(folder: Path) -> Files:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


SHOWN = {"report.pdf": PDF, "images/slices.png": png(PICTURE), "images/bones.png": png(PICTURE[::-1])}
#: What lies beside them and is no part of the report's pictures.
BESIDE = {"images/motion.webm": b"film", "report.html": b"<p>"}


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Makes the finished case P001 in ``cases`` and ``results`` of the current folder."""
    monkeypatch.chdir(tmp_path)

    def finished(case: Files | None = None, shown: Files | None = None) -> None:
        case = case_files(with_identity()) if case is None else case
        write(Path("cases/P001"), case)
        write(Path("results/P001/90_package"), package_of(case, BESIDE | (SHOWN if shown is None else shown)))

    return finished


def export(*options: str) -> ExitCode:
    return ExitCode(cli.execute(["export", "P001", "--out", "out", *options]))


def test_the_report_and_its_pictures_are_written(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    make()
    before = written(Path("results")), written(Path("cases"))
    assert export("--format", "dicom") == ExitCode.PASS
    made = written(Path("out"))
    assert set(made) == {"dicom/report.dcm", "dicom/slices.dcm", "dicom/bones.dcm"}
    found = {name: dcmread(io.BytesIO(data)) for name, data in made.items()}
    assert {(str(one.PatientName), one.PatientID, one.StudyDescription) for one in found.values()} == {
        ("Doe^Jane", "MRN-4711", "CT knee")
    }
    np.testing.assert_array_equal(found["dicom/slices.dcm"].pixel_array, PICTURE)
    np.testing.assert_array_equal(found["dicom/bones.dcm"].pixel_array, PICTURE[::-1])
    assert found["dicom/report.dcm"].EncapsulatedDocument[: len(PDF)] == PDF
    assert (written(Path("results")), written(Path("cases"))) == before
    said = capsys.readouterr().out
    assert said.splitlines()[0] == "out/dicom/report.dcm  0.00 MB"
    assert said.splitlines()[-1].startswith("The files in dicom/ name the patient")
    assert "Doe" not in said


def test_only_we_and_our_group_may_read_a_name(make: Make) -> None:
    make()
    export("--format", "dicom")
    assert {stat.S_IMODE(path.stat().st_mode) for path in Path("out/dicom").iterdir()} == {0o640}


def test_twice_is_the_same_and_takes_the_place_of_the_first(make: Make) -> None:
    make()
    export("--format", "dicom")
    first = written(Path("out"))
    Path("out/dicom/report.dcm").write_bytes(b"half")
    export("--format", "dicom")
    assert written(Path("out")) == first


def test_dicom_is_never_made_unasked(make: Make) -> None:
    make()
    assert export() == ExitCode.PASS
    assert "dicom" not in FORMATS
    assert not Path("out/dicom").exists()
    assert Path("out/lut.json").is_file()
    assert export("--format", "json,dicom") == ExitCode.PASS
    assert Path("out/dicom/report.dcm").is_file()


def test_an_unknown_format_is_told_all_there_are(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    make()
    assert export("--format", "dicom,dcm") == ExitCode.USAGE
    assert "unknown format 'dcm', expected one of " in (said := capsys.readouterr().err)
    assert all(name in said for name in (*FORMATS, "dicom"))
    assert not Path("out").exists()


def test_a_package_without_a_pdf_gives_pictures_and_says_so(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    make(shown={name: data for name, data in SHOWN.items() if name != "report.pdf"})
    assert export("--format", "dicom") == ExitCode.PASS
    assert set(written(Path("out"))) == {"dicom/slices.dcm", "dicom/bones.dcm"}
    assert "This package holds no report.pdf" in capsys.readouterr().out


@pytest.mark.parametrize("other", [{"labels.nrrd": b"x"}, {"ct.nii.gz": b"x", "labels.nrrd": b"x"}])
def test_without_a_dicom_series_there_is_no_study(other: Files, make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    make({**other, "case.yaml": b"side: left\n"})
    assert export("--format", "dicom") == ExitCode.USAGE
    assert capsys.readouterr().err.startswith("E-EXP-03  P001 came without a DICOM series")


def test_labels_that_came_along_do_not_matter(make: Make) -> None:
    make({**case_files(with_identity()), "labels.nrrd": encode_nrrd(leg()), "ct/notes.txt": b"left knee"})
    assert export("--format", "dicom") == ExitCode.PASS


@pytest.mark.parametrize("change", ["another patient", "a slice more", "a slice less", "landmarks", "changed labels"])
def test_other_files_than_the_result_was_made_from(change: str, make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    make({**case_files(with_identity()), "labels.nrrd": b"labels"})
    case = Path("cases/P001")
    if change == "another patient":
        write(case, case_files(with_identity({"PatientName": b"Roe^Jane", "PatientID": b"1"})))
    elif change == "a slice less":
        (case / "ct/IM0003.dcm").unlink()
    else:
        name = {"a slice more": "ct/IM0013.dcm", "landmarks": "landmarks.mrk.json"}.get(change, "labels.nrrd")
        write(case, {name: b"new"})
    assert export("--format", "dicom") == ExitCode.REJECTED
    assert capsys.readouterr().err.startswith(
        "E-EXP-04  The files of P001 are not those that its result was made from."
    )
    assert not Path("out").exists()


@pytest.mark.parametrize("place", ["results/P001/archive", "results", "cases/P001", "out/../results/P001"])
def test_no_name_goes_among_the_results_or_cases(place: str, make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    make()
    assert export("--format", "dicom", "--out", place) == ExitCode.USAGE
    assert capsys.readouterr().err.startswith("E-EXP-06")
    assert not [path for path in Path.cwd().rglob("*.dcm") if path.parent.name != "ct"]
    assert export("--format", "json", "--out", "results/P001/json") == ExitCode.PASS


@pytest.mark.parametrize("name", ["report.pdf", "images/slices.png"])
def test_what_is_not_as_it_was_written_is_not_archived(
    name: str, make: Make, capsys: pytest.CaptureFixture[str]
) -> None:
    make()
    (Path("results/P001/90_package") / name).write_bytes(b"%PDF-")
    assert export("--format", "dicom") == ExitCode.USAGE
    assert capsys.readouterr().err.startswith(f"E-EXP-02  {name} of the package is not as it was written.")


@pytest.mark.parametrize("key", ["joint", "verdict", "sources_sha256", "files"])
def test_a_manifest_that_is_not_complete_is_refused(key: str, make: Make) -> None:
    make()
    package = written(Path("results/P001/90_package"))
    manifest = json.loads(package["manifest.json"])
    del manifest[key]
    with pytest.raises(ValueError, match=f"the package is not complete: '{key}'"):
        dicom_files("P001", Path("cases/P001"), {**package, "manifest.json": json.dumps(manifest).encode()})


def test_a_missing_case_or_package_is_told(make: Make, capsys: pytest.CaptureFixture[str]) -> None:
    make()
    assert export("--format", "dicom", "--cases", "elsewhere") == ExitCode.REJECTED
    assert capsys.readouterr().err.startswith("E-IO-03  The case folder of P001 does not exist.")
    assert export("--format", "dicom", "--results", "elsewhere") == ExitCode.USAGE
    assert capsys.readouterr().err.startswith("E-EXP-01  P001 has no finished package yet.")


def test_errors_are_those_of_the_case_or_of_the_request(make: Make) -> None:
    make(case_files(with_identity({"PatientName": b"Doe\x07"})))
    package = written(Path("results/P001/90_package"))
    with pytest.raises(CaseRejected, match=r"E-EXP-05 PatientName of ct/IM0001\.dcm cannot be repeated"):
        dicom_files("P001", Path("cases/P001"), package)
    shutil.rmtree("cases/P001/ct")
    write(Path("cases/P001"), {"labels.nrrd": b"x"})
    with pytest.raises(ConfigError, match="E-EXP-03"):
        dicom_files("P001", Path("cases/P001"), package)


def errors_of(data: bytes, file: Path) -> list[str]:
    """What the validator finds wrong with an object; that it knows its class is part of it."""
    assert DCIODVFY is not None
    file.write_bytes(data)
    answer = subprocess.run([DCIODVFY, str(file)], capture_output=True, text=True, check=False, errors="replace")
    lines = (answer.stdout + answer.stderr).splitlines()
    assert {"SCImage", "EncapsulatedPDF"} & set(lines)
    return [line for line in lines if line.startswith(("Error", "Abort"))]


validated = pytest.mark.skipif(DCIODVFY is None, reason="needs dciodvfy (Debian: apt-get install dicom3tools)")


@validated
@pytest.mark.parametrize(("charset", "name"), [*NAMES, (None, "SYNTHETIC")])
def test_the_validator_finds_no_error_whatever_the_name(
    charset: str | list[str] | None, name: str, tmp_path: Path
) -> None:
    case = case_files(named(charset, name))
    write(tmp_path, case)
    found = dicom_files("P001", tmp_path, package_of(case, SHOWN))
    assert len(found) == 3
    assert not [error for data in found.values() for error in errors_of(data, tmp_path / "one.dcm")]


@validated
def test_the_validator_finds_no_error_with_all_that_a_hospital_says(tmp_path: Path) -> None:
    case = case_files(with_identity())
    write(tmp_path, case)
    found = dicom_files("P001", tmp_path, package_of(case, SHOWN))
    assert not [error for data in found.values() for error in errors_of(data, tmp_path / "one.dcm")]


@validated
def test_the_validator_would_find_one(tmp_path: Path) -> None:
    """Without the side, and without a word on what is burned in, it finds an error."""
    study = study_of(with_identity())
    for dataset, keyword in ((captures(study)["bones"], "Laterality"), (report(study), "BurnedInAnnotation")):
        del dataset[keyword]
        buffer = io.BytesIO()
        dataset.save_as(buffer)
        assert any(keyword in error.replace(" ", "") for error in errors_of(buffer.getvalue(), tmp_path / "one.dcm"))
