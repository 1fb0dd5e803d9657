"""Thirty-three faulty series, none of them read in silence; and how many a widely used library reads all the same.

The faults are those that were measured on that library before this program was written.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from pipeline.errors import CaseRejected
from pipeline.files.checksums import check_checksums
from pipeline.files.dicom_writer import SeriesSpec, encode_series
from pipeline.geometry.volume import CtVolume
from tests.files.dicom_samples import (
    Files,
    at_heights,
    codes,
    ds,
    height,
    leg,
    read,
    scout,
    series,
    tilted,
    with_edited,
    without,
)

LEG, FILES = leg(), series()
MIDDLE = "IM0006.dcm"
HALF = [f"IM{n:04d}.dcm" for n in range(1, 7)]


def cut(name: str, files: Files, part: float) -> Files:
    return {**files, name: files[name][: int(len(files[name]) * part)]}


def cut_in_syntax(syntax: str) -> Files:
    return cut(MIDDLE, series(SeriesSpec(syntax=syntax)), 0.97)


def heights_after(step: float) -> Files:
    return at_heights(FILES, {name: height(name) + step * max(n - 5, 0) for n, name in enumerate(FILES)})


def jitter() -> Files:
    drawn = np.random.default_rng(5).uniform(-0.05, 0.05, len(FILES))
    return at_heights(FILES, {name: height(name) + off for name, off in zip(FILES, drawn, strict=True)})


def turned_bit(bit: int | None) -> Files:
    """One bit of the stored value of one voxel of bone turned, as in an uncompressed file; none for None."""
    values = LEG.values.astype(np.int32)
    if bit is not None:
        values[10, 8, 5] = ((values[10, 8, 5] + 1024) ^ (1 << bit)) - 1024
    return encode_series(CtVolume(values.astype(np.int16), LEG.lps_from_index), SeriesSpec(signed=False))


#: What is wrong -> the series, and the code it ends with.
FAULTY: dict[str, tuple[Callable[[], Files], str]] = {
    "one slice missing": (lambda: without(FILES, MIDDLE), "E-DCM-09"),
    "four slices missing": (lambda: without(FILES, *[f"IM{n:04d}.dcm" for n in range(5, 9)]), "E-DCM-09"),
    "first slice missing": (lambda: without(FILES, "IM0001.dcm"), "N-DCM-05"),
    "a slice twice": (lambda: {**FILES, "again.dcm": FILES[MIDDLE]}, "N-DCM-01"),
    "two spacings": (lambda: heights_after(2.0), "E-DCM-11"),
    "jitter of 0.05 mm": (jitter, "E-DCM-11"),
    "tilt of 0.5 deg": (lambda: tilted(FILES, 0.5), "E-GEO-04"),
    "tilt of 1 deg": (lambda: tilted(FILES, 1.0), "E-GEO-04"),
    "tilt of 2 deg": (lambda: tilted(FILES, 2.0), "E-GEO-04"),
    "tilt of 5 deg": (lambda: tilted(FILES, 5.0), "E-GEO-04"),
    "tilt of 15 deg": (lambda: tilted(FILES, 15.0), "E-GEO-04"),
    "a scout of the same size": (lambda: {**FILES, "IM0000.dcm": scout(FILES, localizer=False)}, "N-DCM-01"),
    "a scout of another size": (lambda: {**FILES, "IM0000.dcm": scout(FILES, localizer=False, size=33)}, "N-DCM-01"),
    "two patients": (lambda: with_edited(FILES, {"PatientID": b"other"}, *HALF), "E-DCM-02"),
    "another rescale in one slice": (lambda: with_edited(FILES, {"RescaleIntercept": b"-24"}, MIDDLE), "E-DCM-13"),
    "another rescale in half": (lambda: with_edited(FILES, {"RescaleSlope": b"2"}, *HALF), "E-DCM-13"),
    "no rescale": (lambda: with_edited(FILES, {"RescaleIntercept": None, "RescaleSlope": None}), "E-DCM-12"),
    "a slope of 0": (lambda: with_edited(FILES, {"RescaleSlope": b"0"}), "E-DCM-12"),
    "another pixel size in one slice": (lambda: with_edited(FILES, {"PixelSpacing": ds(2, 2)}, MIDDLE), "E-DCM-13"),
    "no pixel size": (lambda: with_edited(FILES, {"PixelSpacing": None}), "E-DCM-07"),
    "no positions": (lambda: with_edited(FILES, {"ImagePositionPatient": None}), "E-DCM-07"),
    "directions not of length 1": (
        lambda: with_edited(FILES, {"ImageOrientationPatient": ds(0.9, 0, 0, 0, 0.9, 0)}),
        "E-DCM-08",
    ),
    "directions not at right angles": (
        lambda: with_edited(FILES, {"ImageOrientationPatient": ds(1, 0, 0, 0.1, 0.995, 0)}),
        "E-DCM-08",
    ),
    "a file cut": (lambda: cut(MIDDLE, FILES, 0.7), "E-IO-11"),
    "a file cut, JPEG-LS": (lambda: cut_in_syntax("JPEG-LS lossless"), "E-IO-11"),
    "a file cut, JPEG lossless": (lambda: cut_in_syntax("JPEG lossless"), "E-IO-11"),
    "a file cut, JPEG 2000": (lambda: cut_in_syntax("JPEG 2000 lossless"), "E-IO-11"),
    "an empty file": (lambda: {**FILES, MIDDLE: b""}, "E-IO-11"),
    "no DICOM inside": (lambda: {**FILES, MIDDLE: b"<html>404</html>" * 20}, "E-IO-11"),
    "a header cut": (lambda: {**FILES, MIDDLE: FILES[MIDDLE][:300]}, "E-IO-11"),
    "a high bit turned": (lambda: turned_bit(14), "W-CT-02"),
}
#: Two that no look at the files can find: a list of checksums does.
UNSEEN: dict[str, Callable[[], Files]] = {
    "a low bit turned": lambda: turned_bit(3),
    "last slice missing": lambda: without(FILES, "IM0012.dcm"),
}


def told(files: Files) -> set[str]:
    """The code of a refusal, or of every finding."""
    try:
        return set(codes(read(files)))
    except CaseRejected as error:
        return {error.code}


@pytest.mark.parametrize("fault", FAULTY)
def test_no_fault_passes_in_silence(fault: str) -> None:
    make, code = FAULTY[fault]
    assert told(make()) == {code}


@pytest.mark.parametrize("fault", UNSEEN)
def test_what_nothing_shows_a_list_of_checksums_does(fault: str) -> None:
    files = UNSEEN[fault]()
    assert told(files) == set()
    sent = turned_bit(None) if "bit" in fault else FILES
    lines = (f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in sent.items())
    arrived = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    with pytest.raises(CaseRejected, match=r"^E-IO-31 "):
        check_checksums(arrived, {"SHA256SUMS": "".join(lines).encode()})


def test_thirty_three_in_all() -> None:
    assert len(FAULTY) + len(UNSEEN) == 33


def test_a_widely_used_reader_takes_most_of_them(tmp_path: Path) -> None:
    """The control: the faults are real ones, which a reader that is not asked to look does not see."""
    taken = 0
    for number, make in enumerate([*(make for make, _ in FAULTY.values()), *UNSEEN.values()]):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name, data in make().items():
            (folder / name).write_bytes(data)
        taken += reads(folder)
    assert taken == 32


def reads(folder: Path) -> bool:
    """Whether SimpleITK makes a volume of a folder."""
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        names = SimpleITK.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder))
        return bool(SimpleITK.ReadImage(names).GetSize()[2] > 1)
    except RuntimeError:
        return False
    finally:
        SimpleITK.ProcessObject.SetGlobalWarningDisplay(True)
