"""``lut.h5``: round trip, equal bytes, the outside checker, CF readers, and everything a foreign file may try."""

from __future__ import annotations

import importlib.util
import io
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np
import pytest

from pipeline.files.lut_content import LutFileContent
from pipeline.files.lut_file import decode_lut, encode_lut
from pipeline.files.lut_schema import DATASETS, FLAGS, MINOR, SCALES, arrays_of, links, root_attributes
from pipeline.kinematics.table import Grid, Status
from tests.files.lut_sample import content

CHECKOUT = Path(__file__).resolve().parents[2]
CHECKER = CHECKOUT.parent / "shared/tools/check_package.py"
PAGE = CHECKOUT / "docs/lut-format.md"
BAD = ((3, 1), (4, 1))
SIDES = pytest.mark.parametrize("side", ["right", "left"])


@pytest.fixture(scope="module")
def good() -> bytes:
    return encode_lut(content(bad=BAD))


@pytest.fixture(scope="module")
def checker() -> ModuleType:
    if not CHECKER.exists():
        pytest.skip("the outside checker is not beside this checkout (shared/tools/check_package.py)")
    spec = importlib.util.spec_from_file_location("check_package", CHECKER)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def changed(data: bytes, change: Callable[[Any], object]) -> bytes:
    """The file after someone else's program had it."""
    buffer = io.BytesIO(data)
    with h5py.File(buffer, "r+") as file:
        change(file)
    return buffer.getvalue()


def assert_equal(one: LutFileContent, other: LutFileContent) -> None:
    first, second = arrays_of(one), arrays_of(other)
    for path, array in first.items():
        assert array.dtype == second[path].dtype, path
        np.testing.assert_array_equal(array, second[path], err_msg=path)
    assert root_attributes(one) == root_attributes(other)
    for a, b in zip(one.smooth.fits, other.smooth.fits, strict=True):
        assert (a.name, a.unit, a.residual_rms, a.residual_max) == (b.name, b.unit, b.residual_rms, b.residual_max)
        np.testing.assert_array_equal(a.coefficients, b.coefficients)


@SIDES
def test_round_trip(side: str) -> None:
    original = content(side, bad=BAD)
    assert_equal(decode_lut(encode_lut(original)), original)


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 3)])
def test_round_trip_of_the_smallest_grids(shape: tuple[int, int]) -> None:
    original = content(grid=Grid(np.arange(float(shape[0])), np.arange(float(shape[1]))))
    assert_equal(decode_lut(encode_lut(original)), original)


def test_a_table_without_fits_round_trips() -> None:
    original = content()
    bare = replace(original, smooth=replace(original.smooth, fits=()))
    assert decode_lut(encode_lut(bare)).smooth.fits == ()


def test_equal_tables_give_equal_bytes_in_any_process(good: bytes) -> None:
    assert encode_lut(content(bad=BAD)) == good
    script = (
        "import hashlib; from pipeline.files.lut_file import encode_lut; from tests.files.lut_sample import content\n"
        f"print(hashlib.sha256(encode_lut(content(bad={BAD}))).hexdigest())"
    )
    digests = {
        subprocess.run(
            [sys.executable, "-c", script],
            cwd=CHECKOUT,
            env={"PYTHONHASHSEED": seed, "PATH": "", "TZ": zone},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed, zone in (("1", "UTC"), ("77", "Asia/Tokyo"))
    }
    assert len(digests) == 1


@SIDES
def test_the_outside_checker_accepts_format_and_formula(tmp_path: Path, checker: ModuleType, side: str) -> None:
    path = tmp_path / "lut.h5"
    path.write_bytes(encode_lut(content(side, bad=BAD)))
    lut, usable = checker.load(path)
    assert usable.sum() == usable.size - len(BAD)
    for i, j in np.argwhere(usable):
        theirs = checker.moved(lut, lut["flexion"][i], lut["varus"][j], lut["pose"][i, j])
        np.testing.assert_allclose(lut["matrix"][i, j], theirs, rtol=0, atol=1e-9)


def test_every_dataset_says_what_it_is_and_is_checksummed(good: bytes) -> None:
    with h5py.File(io.BytesIO(good)) as file:
        found: list[str] = []
        file.visit(found.append)
        # a dataset with several links is visited once, by one of them
        visited = {f"/{name}" for name in found if isinstance(file[name], h5py.Dataset)}
        assert visited <= {spec.path for spec in DATASETS} | set(links(MINOR))
        assert len(visited) == len(DATASETS)
        for spec in DATASETS:
            dataset = file[spec.path]
            assert dataset.fletcher32, spec.path
            assert dataset.attrs["unit"] == spec.unit
            assert dataset.attrs["description"].startswith(spec.title)
            assert not dataset.id.get_create_plist().get_obj_track_times()
            np.testing.assert_array_equal(dataset.fillvalue, spec.fill)


def test_the_names_of_the_status_are_its_values(good: bytes) -> None:
    assert tuple(status.name.lower() for status in Status) == FLAGS
    with h5py.File(io.BytesIO(good)) as file:
        for group in ("lut", "raw", "neutral"):
            attributes = file[f"{group}/status"].attrs
            assert tuple(attributes["flags"]) == tuple(attributes["flag_meanings"].split()) == FLAGS
            np.testing.assert_array_equal(attributes["flag_values"], list(Status))


def test_raw_has_every_name_of_the_table(good: bytes) -> None:
    with h5py.File(io.BytesIO(good)) as file:
        assert set(file["lut"]) <= set(file["raw"])


def test_what_is_unusable_is_nan(good: bytes) -> None:
    with h5py.File(io.BytesIO(good)) as file:
        for cell in BAD:
            assert np.isnan(file["lut/moved_from_scan"][cell]).all()
            assert np.isnan(file["lut/lateral_mm"][cell])


def test_the_neutral_curve_runs_along_the_flexion_of_the_grid(good: bytes) -> None:
    expected = content(bad=BAD).neutral
    with h5py.File(io.BytesIO(good)) as file:
        assert set(file["neutral"]) == {field.name for field in fields(expected)} | {"neutral_varus_deg"}
        assert file["neutral/flexion_deg"] == file["grid/flexion_deg"]
        assert file["neutral/neutral_varus_deg"] == file["neutral/varus_deg"]
        for field in fields(expected)[1:]:
            dataset = file["neutral"][field.name]
            assert dataset.dims[0].values() == [file["grid/flexion_deg"]], field.name
            np.testing.assert_array_equal(dataset, getattr(expected, field.name))
        assert np.isnan(file["neutral/varus_deg"][-1])
        assert file["neutral/status"][-1] == Status.NO_CONTACT


def as_version_1_0(data: bytes) -> bytes:
    """The file as the first version had it: without what was added later."""

    def older(file: Any) -> None:
        file.attrs["version"] = "1.0"
        for path in sorted({*links(MINOR)} - {*links(0)}):
            del file[path]
        for spec in DATASETS:
            if spec.since:
                del file[spec.path]

    return changed(data, older)


def test_a_table_of_version_1_0_is_read(good: bytes) -> None:
    older = as_version_1_0(good)
    with h5py.File(io.BytesIO(older)) as file:
        assert "xyz" not in file
        assert sorted(file["lut"])[-1] == "varus_deg"
    assert_equal(decode_lut(older), content(bad=BAD))
    with pytest.raises(ValueError, match="/smoothing/midpoint_error_mm: expected 12 flexion intervals"):
        decode_lut(changed(older, _remake("smoothing/midpoint_error_mm", data=np.zeros((13, 4)))))


def test_a_table_of_version_1_0_holds_nothing_of_later_versions(good: bytes) -> None:
    data = changed(good, lambda file: file.attrs.__setitem__("version", "1.0"))
    with pytest.raises(ValueError, match="/: unknown member 'corner'"):
        decode_lut(data)


BREAKS: dict[str, tuple[Callable[[LutFileContent], LutFileContent], str]] = {
    "side": (lambda c: replace(c, side="both"), "side: expected right or left"),
    "handedness": (lambda c: replace(c, side="left"), "expected a left-handed frame"),
    "skewed frame": (lambda c: replace(c, scan_from_moving=c.scan_from_moving * 1.01), "expected a rigid frame"),
    "nan frame": (lambda c: replace(c, scan_from_reference=np.full((4, 4), np.nan)), "expected a finite 4x4"),
    "delta": (lambda c: replace(c, delta=-c.delta), "expected the z axis of scan_from_moving"),
    "attitude": (lambda c: replace(c, scan_attitude=np.zeros(5)), "expected six finite numbers"),
    "no triangle": (lambda c: _body(c, triangles=np.zeros((0, 3), np.int32)), "at least one triangle"),
    "wild triangle": (lambda c: _body(c, triangles=np.full((1, 3), 8, np.int32)), r"indices outside 0\.\.7"),
    "flat points": (lambda c: _body(c, points=np.zeros((8, 2))), r"expected points \(N, 3\)"),
    "nan point": (lambda c: _body(c, points=np.full((8, 3), np.nan)), "expected finite points"),
    "falling grid": (lambda c: _grid(c, c.smooth.grid.flexion_deg[::-1]), "strictly increasing"),
    "two grids": (
        lambda c: replace(c, raw=content(grid=Grid(c.smooth.grid.flexion_deg + 1, c.smooth.grid.varus_deg)).raw),
        "the raw and the smoothed table differ",
    ),
    "shape": (lambda c: _poses(c, medial_gap_mm=np.zeros((2, 2))), "lut medial_gap_mm: expected shape"),
    "status": (lambda c: _poses(c, status=c.smooth.poses.status + np.uint8(6)), "lut status: expected 0 to 5, got 6"),
    "usable nan": (
        lambda c: _poses(c, lateral_mm=c.smooth.poses.lateral_mm * np.nan),
        "lut: a usable entry has a coor",
    ),
    "pose where there is none": (
        lambda c: _poses(c, status=c.smooth.poses.status + np.uint8(2)),
        "lut: an entry that is not usable has a coordinate",
    ),
    "neutral shape": (
        lambda c: _neutral(c, uneven_mm=np.zeros(3)),
        r"neutral uneven_mm: expected shape \(13,\) of the grid, got \(3,\)",
    ),
    "neutral flexion": (
        lambda c: _neutral(c, flexion_deg=c.neutral.flexion_deg + 1.0),
        "neutral flexion_deg: expected the flexion of the grid",
    ),
    "neutral status": (
        lambda c: _neutral(c, status=c.neutral.status + np.uint8(6)),
        "neutral status: expected 0 to 5, got 10",
    ),
    "neutral nan": (
        lambda c: _neutral(c, varus_deg=c.neutral.varus_deg * np.nan),
        "neutral: a usable entry has a coor",
    ),
    "neutral pose where there is none": (
        lambda c: _neutral(c, proximal_mm=np.zeros(13)),
        "neutral: an entry that is not usable has a coordinate",
    ),
    "type": (
        lambda c: _poses(c, medial_gap_mm=c.smooth.poses.medial_gap_mm.astype(np.float32)),
        "/lut/medial_gap_mm: expected float64, got float32",
    ),
}


def _body(c: LutFileContent, **parts: Any) -> LutFileContent:
    return replace(c, moving_body=replace(c.moving_body, **parts))


def _neutral(c: LutFileContent, **arrays: Any) -> LutFileContent:
    return replace(c, neutral=replace(c.neutral, **arrays))


def _grid(c: LutFileContent, flexion: Any) -> LutFileContent:
    grid = Grid(flexion, c.smooth.grid.varus_deg)
    return replace(c, smooth=replace(c.smooth, grid=grid), raw=replace(c.raw, grid=grid))


def _poses(c: LutFileContent, **arrays: Any) -> LutFileContent:
    return replace(c, smooth=replace(c.smooth, poses=replace(c.smooth.poses, **arrays)))


@pytest.mark.parametrize("name", BREAKS)
def test_a_table_that_could_not_be_trusted_is_not_written(name: str) -> None:
    change, sentence = BREAKS[name]
    with pytest.raises(ValueError, match=sentence):
        encode_lut(change(content()))


def _swap(path: str, link: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[path]
        file[path] = link

    return change


def _remake(path: str, **arguments: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[path]
        file.create_dataset(path, **arguments)

    return change


def _virtual(file: Any) -> None:
    del file["frames/delta"]
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "secret", shape=(3,))
    file.create_virtual_dataset("frames/delta", layout)


def _with_a_midpoint_more(file: Any) -> None:
    _remake("smoothing/midpoint_error_mm", data=np.zeros((13, 4)))(file)
    _remake("smoothing/flexion_midpoint_deg", data=np.zeros(13))(file)


def _unsealed(name: str, text: str) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file.attrs["text_crc32"]
        file["smoothing"].attrs[name] = text

    return change


FOREIGN: dict[str, tuple[Callable[[Any], object], str]] = {
    "external link": (
        _swap("lut/lateral_mm", h5py.ExternalLink("elsewhere.h5", "/secret")),
        "/lut/lateral_mm: expected a member of this file",
    ),
    "external group": (
        _swap("bodies", h5py.ExternalLink("elsewhere.h5", "/bodies")),
        "/bodies: expected a member of this file",
    ),
    "soft link": (_swap("lut/lateral_mm", h5py.SoftLink("/lut/anterior_mm")), "found nothing or a link"),
    "missing": (lambda f: f.__delitem__("lut/status"), "/lut/status: expected a member"),
    "group in place of data": (lambda f: _swap("frames/delta", f["lut"])(f), "/frames/delta: expected a dataset"),
    "unknown member": (lambda f: f.create_group("lut/extra"), "/lut: unknown member 'extra'"),
    "virtual": (_virtual, "stored outside the file"),
    "external storage": (
        _remake("frames/delta", shape=(3,), dtype="f8", external=[("secret.txt", 0, 24)]),
        "stored outside the file",
    ),
    "other filter": (_remake("frames/delta", data=np.zeros(3), compression="lzf"), "by an unknown filter"),
    "never written": (_remake("frames/delta", shape=(3,), dtype="f8", chunks=(3,)), "was declared and never written"),
    "wrong type": (_remake("frames/delta", data=np.zeros(3, np.float32)), "expected float64, got float32"),
    "text": (_remake("frames/delta", data=["a", "b", "c"]), "/frames/delta: expected float64, got object"),
    "wrong size": (_remake("frames/delta", data=np.zeros(4)), "expected 3 values along xyz, got 4"),
    "wrong rank": (_remake("frames/delta", data=np.zeros((3, 1))), "expected 1 dimensions, got 2"),
    "bomb": (
        _remake("bodies/moving/points", shape=(10**12, 3), dtype="f8", chunks=(1000, 3)),
        "declares 24000000000000 bytes and stores 0",
    ),
    "dense bomb": (
        _remake(
            "bodies/moving/points", data=np.zeros((10**6, 3)), chunks=(10**6, 3), compression="gzip", compression_opts=9
        ),
        r"declares 24000000 bytes and stores \d+$",
    ),
    "short neutral curve": (
        _remake("neutral/varus_deg", data=np.zeros(12)),
        "/neutral/varus_deg: expected 13 values along flexion_deg, got 12",
    ),
    "intervals": (_with_a_midpoint_more, "expected 12 flexion intervals"),
    "edited table": (lambda f: f["lut/lateral_mm"].__setitem__((0, 0), 9.0), "/lut/moved_from_scan: does not follow"),
    "edited neutral curve": (
        lambda f: f["neutral/status"].__setitem__(0, 4),
        "neutral: an entry that is not usable has a coordinate",
    ),
    "edited scale": (
        lambda f: f["frames/coordinate"].__setitem__(0, 5),
        "/frames/coordinate: does not number the values along coordinate",
    ),
    "edited midpoints": (
        lambda f: f["smoothing/flexion_midpoint_deg"].__setitem__(0, 0.0),
        "/smoothing/flexion_midpoint_deg: does not number",
    ),
    "scale of another size": (
        _remake("smoothing/curve", data=np.arange(3, dtype="i4")),
        "/smoothing/curve: expected 2 values along curve, got 3",
    ),
    "scale elsewhere": (_swap("xyz", h5py.ExternalLink("elsewhere.h5", "/xyz")), "/xyz: expected a member"),
    "edited motion": (
        lambda f: f["raw/moved_from_scan"].__setitem__((1, 1, 0, 3), 9.0),
        "/raw/moved_from_scan: does not follow",
    ),
    "other file": (lambda f: f.attrs.__setitem__("format", "other"), "not a table of ct2lut"),
    "newer": (
        lambda f: f.attrs.__setitem__("version", "2.0"),
        r"has format version 2\.0, this program reads version 1; use the program",
    ),
    "no version": (lambda f: f.attrs.__setitem__("version", "first"), "has format version first"),
    "number as text": (lambda f: f.attrs.__setitem__("joint", 7), "expected a short text attribute joint"),
    "control characters": (
        lambda f: f.attrs.__setitem__("joint", "knee\x1b[2J"),
        "expected a short text attribute joint",
    ),
    "long text": (lambda f: f.attrs.__setitem__("joint", "k" * 1000), "expected a short text attribute joint"),
    "edited text": (lambda f: f.attrs.__setitem__("joint", "knie"), "the texts do not have the checksum text_crc32"),
    "curve names": (_unsealed("curves", "one"), "one name and unit for each of 2 curves"),
    "basis": (_unsealed("basis", "monomial"), "expected basis chebyshev"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_foreign_file_is_refused(good: bytes, name: str) -> None:
    change, sentence = FOREIGN[name]
    data = changed(good, change)
    with pytest.raises(ValueError, match=sentence):
        decode_lut(data)


def test_a_later_minor_version_may_hold_more(good: bytes) -> None:
    def later(file: Any) -> None:
        file.attrs["version"] = "1.7"
        file["lut/news"] = h5py.ExternalLink("elsewhere.h5", "/not/opened")

    assert_equal(decode_lut(changed(good, later)), content(bad=BAD))


@pytest.mark.parametrize("data", [b"", b"not HDF5", b"\x89HDF\r\n\x1a\n" + bytes(400)], ids=["empty", "text", "header"])
def test_what_is_no_hdf5_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="not a readable table, or a damaged one"):
        decode_lut(data)


def test_a_truncated_file_is_refused(good: bytes) -> None:
    for end in range(0, len(good), len(good) // 25):
        with pytest.raises(ValueError, match="not a readable table, or a damaged one"):
            decode_lut(good[:end])


def test_a_flipped_bit_is_refused_or_harmless(good: bytes) -> None:
    rng, original = np.random.default_rng(0), content(bad=BAD)
    for _ in range(120):
        data = bytearray(good)
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        try:
            read = decode_lut(bytes(data))
        except ValueError:
            continue
        assert_equal(read, original)


def test_the_format_page_lists_every_dataset() -> None:
    page = PAGE.read_text()
    for spec in DATASETS:
        group, _, name = spec.path.rpartition("/")
        assert f"`{name}`" in page or f"`{spec.path}`" in page, spec.path
        assert f"`{group or '/'}`" in page, spec.path
    for scale in SCALES.values():
        assert scale.rpartition("/")[2] in page
    for name in root_attributes(content()):
        assert f"`{name}`" in page, name


def test_the_examples_of_the_format_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, good: bytes) -> None:
    pytest.importorskip("xarray")
    monkeypatch.chdir(tmp_path)
    Path("lut.h5").write_bytes(good)
    examples = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(examples) == 4
    names: dict[str, Any] = {}
    for example in examples:
        exec(compile(example, PAGE.name, "exec"), names)
    names["lut"] = names["frames"] = names["xarray"] = None  # closes what the reader left open
    assert names["placed"].shape == names["points"].shape
    assert names["clip"].shape == (61, 4, 4)
    assert names["six"].flexion_deg == 60.0
    assert names["scan_pose"]["proximal_mm"] == 2.0


def test_content_has_no_field_that_the_file_forgets() -> None:
    read = decode_lut(encode_lut(content()))
    assert all(getattr(read, field.name) is not None for field in fields(read))
