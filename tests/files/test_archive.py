"""The archive: the same bytes for the same files, and nothing that unpacks elsewhere."""

from __future__ import annotations

import io
import zipfile

import pytest

from pipeline.files.archive import encode_zip

FILES = {"b.txt": b"two" * 100, "a/c.bin": bytes(range(256)), "a.txt": b""}


def test_it_holds_the_files_in_one_folder() -> None:
    with zipfile.ZipFile(io.BytesIO(encode_zip(FILES, "case"))) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == ["case/a.txt", "case/a/c.bin", "case/b.txt"]
        assert {name: archive.read(f"case/{name}") for name in FILES} == FILES


def test_order_and_time_leave_no_trace() -> None:
    data = encode_zip(FILES, "case")
    assert encode_zip(dict(reversed(FILES.items())), "case") == data
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert {entry.date_time for entry in archive.filelist} == {(1980, 1, 1, 0, 0, 0)}
        assert {entry.external_attr >> 16 for entry in archive.filelist} == {0o100644}


@pytest.mark.parametrize("name", ["../out", "/etc/x", "a/../../b", "a\\b", "a//b", "./a", "a/"])
def test_a_name_that_leaves_the_folder_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="not a plain file name inside the package"):
        encode_zip({name: b""}, "case")
