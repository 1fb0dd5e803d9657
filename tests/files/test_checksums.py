"""A list of checksums beside the files of a case: what is missing or altered is found, whatever it is."""

from __future__ import annotations

import hashlib

import pytest

from pipeline.errors import CaseRejected
from pipeline.files.checksums import check_checksums, is_checksum_list

FILES = {f"ct/IM{n:02d}.dcm": f"slice {n}".encode() for n in range(5)}


def hashes(files: dict[str, bytes]) -> dict[str, str]:
    return {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}


def sums(files: dict[str, bytes], folder: str = "ct/", mark: str = " ") -> bytes:
    """As ``sha256sum`` writes it in a folder."""
    lines = [f"{checksum} {mark}{name.removeprefix(folder)}\n" for name, checksum in hashes(files).items()]
    return "".join(lines).encode()


@pytest.mark.parametrize("mark", [" ", "*", " ./"])
def test_files_as_listed(mark: str) -> None:
    (note,) = check_checksums(hashes(FILES), {"ct/SHA256SUMS": sums(FILES, mark=mark)})
    assert (note.code, note.message) == ("N-IO-01", "5 files are as listed in ct/SHA256SUMS.")
    (note,) = check_checksums(hashes(FILES), {"all.sha256": sums(FILES, folder="", mark=mark)})
    assert note.message == "5 files are as listed in all.sha256."


def test_a_file_that_is_not_listed_is_named() -> None:
    few = dict(list(FILES.items())[:3])
    (note,) = check_checksums(hashes(FILES), {"ct/SHA256SUMS": sums(few)})
    assert note.message == "3 files are as listed in ct/SHA256SUMS. Not listed: 2 (ct/IM03.dcm)."


@pytest.mark.fault("D02")
@pytest.mark.parametrize("lost", [["ct/IM00.dcm"], ["ct/IM04.dcm"], ["ct/IM00.dcm", "ct/IM01.dcm"]])
def test_a_slice_that_never_came(lost: list[str]) -> None:
    arrived = {name: data for name, data in FILES.items() if name not in lost}
    words = rf"^E-IO-31 {len(lost)} \({lost[0]}\) of 5 files listed in ct/SHA256SUMS are missing"
    with pytest.raises(CaseRejected, match=words):
        check_checksums(hashes(arrived), {"ct/SHA256SUMS": sums(FILES)})


@pytest.mark.fault("D19", "D20")
def test_one_bit_that_turned() -> None:
    data = bytearray(FILES["ct/IM02.dcm"])
    for bit in range(8 * len(data)):
        data[bit // 8] ^= 1 << bit % 8
        with pytest.raises(CaseRejected, match=r"^E-IO-31 1 \(ct/IM02.dcm\) of 5 files are not as listed"):
            check_checksums(hashes({**FILES, "ct/IM02.dcm": bytes(data)}), {"ct/SHA256SUMS": sums(FILES)})
        data[bit // 8] ^= 1 << bit % 8


@pytest.mark.parametrize(
    "text", ["no list", f"{'0' * 63}  a", f"{'0' * 64}  ../../other/a", f"{'0' * 64}\ta", "\xff" * 80]
)
def test_what_is_no_list(text: str) -> None:
    with pytest.raises(CaseRejected, match=r"^E-IO-32 Line 2 of SHA256SUMS is no checksum and file name"):
        check_checksums(hashes(FILES), {"SHA256SUMS": sums({"a": b""}, "") + text.encode("latin-1")})


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("SHA256SUMS", True),
        ("ct/sha256sums.txt", True),
        ("ct/series.sha256", True),
        ("ct/IM1.dcm", False),
        ("sums", False),
    ],
)
def test_lists_are_told_by_their_name(name: str, *, expected: bool) -> None:
    assert is_checksum_list(name) is expected
