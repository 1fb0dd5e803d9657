from __future__ import annotations

import hashlib
import os
import subprocess
from pathlib import Path

import pytest

from pipeline.engine import source
from pipeline.engine.source import list_source, source_hash
from pipeline.errors import CaseRejected


@pytest.fixture
def case(tmp_path: Path) -> Path:
    root = tmp_path / "P1"
    (root / "ct").mkdir(parents=True)
    (root / "labels.nrrd").write_bytes(b"labels")
    (root / "ct" / "slice1.dcm").write_bytes(b"one")
    return root


def test_regular_files_are_listed_with_their_hashes_in_order(case: Path) -> None:
    listed = list_source("P1", case)
    assert list(listed.files) == ["ct/slice1.dcm", "labels.nrrd"]
    assert listed.files["labels.nrrd"] == hashlib.sha256(b"labels").hexdigest()
    assert listed.read("ct/slice1.dcm") == b"one"


def test_what_programs_leave_behind_is_ignored(case: Path) -> None:
    before = source_hash(list_source("P1", case).files)
    for name in (".DS_Store", "._labels.nrrd", "Thumbs.db", "case.yaml~", "#case.yaml#", "~$notes.docx", "desktop.ini"):
        (case / name).write_bytes(b"junk")
    (case / "__MACOSX").mkdir()
    (case / "__MACOSX" / "x").write_bytes(b"junk")
    (case / ".git").mkdir()
    (case / ".git" / "x").write_bytes(b"junk")
    os.mkfifo(case / "pipe")
    assert source_hash(list_source("P1", case).files) == before


def test_the_hash_knows_names_and_contents(case: Path) -> None:
    hashes = [source_hash(list_source("P1", case).files)]
    (case / "labels.nrrd").rename(case / "labels2.nrrd")
    hashes.append(source_hash(list_source("P1", case).files))
    (case / "labels2.nrrd").write_bytes(b"label2")
    hashes.append(source_hash(list_source("P1", case).files))
    assert len(set(hashes)) == 3


def test_the_case_folder_itself_may_be_a_link(case: Path, tmp_path: Path) -> None:
    (tmp_path / "alias").symlink_to(case)
    assert list_source("P1", tmp_path / "alias").files == list_source("P1", case).files


def test_links_that_stay_inside_are_read_once(case: Path) -> None:
    (case / "first.dcm").symlink_to("ct/slice1.dcm")
    (case / "again").symlink_to("ct")
    (case / "ct" / "up").symlink_to("..")
    listed = list_source("P1", case)
    assert list(listed.files) == ["ct/slice1.dcm", "first.dcm", "labels.nrrd"]
    assert listed.read("first.dcm") == b"one"


@pytest.mark.parametrize("target", ["/etc/passwd", "../other/labels.nrrd", "..", "missing", "loop"])
def test_links_that_leave_or_lead_nowhere_are_refused(case: Path, target: str) -> None:
    other = case.parent / "other"
    other.mkdir()
    (other / "labels.nrrd").write_bytes(b"of another patient")
    (case / "loop").symlink_to(target)
    with pytest.raises(CaseRejected, match="E-IO-02 loop is a link that leads out of the case folder or nowhere"):
        list_source("P1", case)


def test_a_missing_or_empty_folder_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(CaseRejected, match=r"E-IO-03 The case folder of P7 does not exist\."):
        list_source("P7", tmp_path / "P7")
    (tmp_path / "P7" / "ct").mkdir(parents=True)
    with pytest.raises(CaseRejected, match=r"E-IO-03 The case folder of P7 holds no files\."):
        list_source("P7", tmp_path / "P7")


@pytest.mark.parametrize("name", [b"bad\xff.dcm", b"new\nline.dcm", b"bell\x07.dcm"])
def test_names_that_are_not_text_are_rejected(case: Path, name: bytes) -> None:
    Path(os.fsdecode(os.fsencode(case) + b"/" + name)).write_bytes(b"x")
    with pytest.raises(CaseRejected, match=r"E-IO-05 The name of file [\x20-\x7e]+ has characters"):
        list_source("P1", case)


def test_an_unreadable_file_is_rejected(case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def deny(path: Path) -> None:
        raise PermissionError(13, "denied", str(path))

    monkeypatch.setattr("pipeline.engine.source.fingerprint_on_disk", deny)
    with pytest.raises(CaseRejected, match=r"E-IO-04 ct/slice1\.dcm cannot be read: permission denied"):
        list_source("P1", case)


def test_a_file_that_changes_after_it_was_listed_is_noticed(case: Path) -> None:
    listed = list_source("P1", case)
    (case / "labels.nrrd").write_bytes(b"still being copied")
    with pytest.raises(ValueError, match=r"labels\.nrrd changed while it was being read"):
        listed.read("labels.nrrd")


@pytest.mark.fault("D25")
def test_folders_however_deep_are_listed_and_too_deep_are_refused(case: Path) -> None:
    here = os.open(case, os.O_RDONLY)
    try:
        for depth in range(1, 2051):
            os.mkdir("d", dir_fd=here)
            inner = os.open("d", os.O_RDONLY, dir_fd=here)
            os.close(here)
            here = inner
            if depth == 1500:  # deeper than functions can call one another
                os.close(os.open("deep.txt", os.O_CREAT | os.O_WRONLY, dir_fd=here))
                assert f"{'d/' * 1500}deep.txt" in list_source("P1", case).files
        with pytest.raises(CaseRejected, match=r"^E-IO-04 A file of P1 cannot be read: its folders lie too deep"):
            list_source("P1", case)
    finally:
        os.close(here)
        subprocess.run(["rm", "-rf", str(case)], check=True)  # deeper than the clean-up of pytest can go


@pytest.mark.fault("D25")
def test_no_more_files_than_one_joint_has(case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source, "MAX_FILES", 4)  # two files in two folders
    assert len(list_source("P1", case).files) == 2
    (case / "empty").mkdir()
    with pytest.raises(CaseRejected, match=r"^E-IO-14 The case folder holds more than 4 files and folders\."):
        list_source("P1", case)


@pytest.mark.fault("D25")
def test_a_huge_file_is_refused_before_it_is_read(case: Path) -> None:
    with (case / "huge.raw").open("wb") as stream:
        stream.truncate(10**13)
    with pytest.raises(CaseRejected, match=r"^E-IO-14 The case folder holds more than 100 GB\."):
        list_source("P1", case)
