"""The grid of a DICOM series: what is even and upright, what nearly is, and what is refused."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pipeline.files.dicom_series import choose_series
from pipeline.files.dicom_stack import check_stack
from pipeline.files.dicom_writer import encode_series
from pipeline.geometry.volume import CtVolume
from tests.files import dicom_samples
from tests.files.dicom_samples import (
    assert_same,
    at_heights,
    codes,
    ds,
    edited,
    headers_of,
    height,
    leg,
    read,
    refused,
    series,
    short,
    tilted,
    with_edited,
    with_positions,
    without,
)

LEG = leg()
FILES = series()
MIDDLE, LAST = "IM0006.dcm", "IM0012.dcm"


@pytest.mark.fault("D01")
@pytest.mark.parametrize(
    ("lost", "neighbours"),
    [
        (("IM0006.dcm",), (5, 7)),
        (("IM0006.dcm", "IM0007.dcm", "IM0008.dcm", "IM0009.dcm"), (5, 10)),
        (("IM0002.dcm",), (1, 3)),
    ],
)
def test_missing_slices_are_placed(lost: tuple[str, ...], neighbours: tuple[int, int]) -> None:
    places = [re.escape(f"{height(f'IM{n:04d}'):g}) mm") for n in neighbours]
    with refused("E-DCM-09", f"{len(lost)} slices are missing .*{places[0]}.*{places[1]}"):
        read(without(FILES, *lost))


@pytest.mark.fault("D04")
def test_the_same_place_twice() -> None:
    twice = edited(FILES[MIDDLE], {"SOPInstanceUID": b"1.2.3", "PixelPaddingValue": short(-2000)})
    with refused("E-DCM-10", "two different slices at the same place"):
        read({**FILES, "IM0099.dcm": twice})
    with refused("E-DCM-10", "claim to be the same image"):
        read({**FILES, "IM0099.dcm": edited(FILES[MIDDLE], {"KVP": b"80"})})


@pytest.mark.fault("D08")
@pytest.mark.parametrize(
    ("mm", "expected"), [(0.0005, []), (0.008, ["N-DCM-04"]), (0.03, ["W-DCM-02"]), (0.09, ["W-DCM-02"])]
)
def test_a_little_uneven(mm: float, expected: list[str]) -> None:
    found = read(at_heights(FILES, {MIDDLE: height(MIDDLE) + mm}))
    assert codes(found) == expected
    np.testing.assert_array_equal(found.volume.values, LEG.values)
    np.testing.assert_allclose(found.volume.lps_from_index, LEG.lps_from_index, atol=1e-6)


@pytest.mark.fault("D08")
@pytest.mark.parametrize("mm", [0.11, -0.2, 0.9, -1.5])
def test_too_uneven(mm: float) -> None:
    with refused("E-DCM-11", "not evenly spaced"):
        read(at_heights(FILES, {MIDDLE: height(MIDDLE) + mm}))


@pytest.mark.fault("D08")
def test_two_pitches() -> None:
    heights = {name: height(name) + 2.0 * max(n - 5, 0) for n, name in enumerate(FILES)}
    with refused("E-DCM-11", "gaps from 2 to 4 mm"):
        read(at_heights(FILES, heights))


@pytest.mark.fault("D08")
def test_a_slow_drift_is_uneven_too() -> None:  # each gap differs by 2 % only, the middle lies 0.12 mm off
    heights = {name: height(name) + 0.04 * max(n - 5, 0) for n, name in enumerate(FILES)}
    with refused("E-DCM-11", "out of place"):
        read(at_heights(FILES, heights))


@pytest.mark.fault("D09")
@pytest.mark.parametrize("degrees", [0.5, 1.0, 2.0, 5.0, 15.0, 30.0])
def test_tilt_is_refused_with_its_angle(degrees: float) -> None:
    with refused("E-GEO-04", f"tilted against their stack by {degrees:g} deg"):
        read(tilted(FILES, degrees))


@pytest.mark.fault("D09")
@pytest.mark.parametrize("degrees", [0.03, 0.1])
def test_a_small_tilt_of_a_short_stack_is_no_right_angle(degrees: float) -> None:
    with refused("E-GEO-04", f"{degrees:g} deg"):
        read(tilted(FILES, degrees))


def test_rounding_is_no_tilt() -> None:
    assert_same(read(tilted(FILES, 0.005)), LEG)


def test_a_slice_pushed_sideways() -> None:
    with refused("E-DCM-14", f"{LAST} lies"):
        read(with_positions(FILES, {LAST: (0.0, dicom_samples.ORIGIN_MM[1], height(LAST))}))


@pytest.mark.fault("D13")
@pytest.mark.parametrize("thickness", [b"0.5", b"-3", b"NaN", None])
def test_thickness_and_declared_spacing_are_ignored(thickness: bytes | None) -> None:
    files = with_edited(FILES, {"SliceThickness": thickness})
    assert_same(
        read(with_edited(files, {"SpacingBetweenSlices": b"7", "SliceLocation": b"3", "InstanceNumber": b"1"})), LEG
    )


@pytest.mark.fault("D11", "D12")
@pytest.mark.parametrize(
    ("keyword", "value"),
    [
        ("PixelSpacing", ds(1.25, 1.01)),
        ("ImageOrientationPatient", ds(1, 0, 0, 0, 0.9998, 0.02)),
        ("RescaleSlope", b"2"),
        ("RescaleIntercept", b"0"),
    ],
)
def test_slices_that_differ(keyword: str, value: bytes) -> None:
    with refused("E-DCM-(13|08)", f"{keyword} of {MIDDLE}"):
        read(with_edited(FILES, {keyword: value}, MIDDLE))


def test_slices_of_another_size() -> None:
    wide = encode_series(CtVolume(np.repeat(LEG.values, 2, axis=0), LEG.lps_from_index))[MIDDLE]
    same = headers_of({MIDDLE: FILES[MIDDLE]})[0]
    tags: dict[str, bytes | None] = {
        "SOPInstanceUID": same.sop_uid.encode(),
        "SeriesInstanceUID": same.series_uid.encode(),
        "StudyInstanceUID": same.study_uid.encode(),
        "FrameOfReferenceUID": same.frame_uid.encode(),
    }
    with refused("E-DCM-13", f"Columns of {MIDDLE} is 48, but 24 in 11 of 12 slices"):
        read({**FILES, MIDDLE: edited(wide, tags)})


def test_the_stack_in_order() -> None:
    stack = check_stack(choose_series(headers_of(dict(reversed(FILES.items())))).slices)
    assert [header.file for header in stack.slices] == list(FILES)
