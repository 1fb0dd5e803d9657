"""The deliverable: complete, consistent, the same bytes twice, and free of the names of the input files."""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from pipeline.artifacts import (
    ANATOMY,
    CASE_FACTS,
    MADE_MESHES,
    MESHES,
    MOVING_BODY,
    NEUTRAL_CURVE,
    PACKAGE,
    RAW_TABLE,
    REFERENCE_BODY,
    REPORT,
    SMOOTH_TABLE,
    SURFACE_ORIGINS,
    VERDICT,
)
from pipeline.engine.artifacts import Artifact
from pipeline.engine.stage import Finding, Severity
from pipeline.exports import export_files, source_of
from pipeline.files.lut_content import LutFileContent
from pipeline.files.lut_file import decode_lut
from pipeline.playback import Lut
from pipeline.records import Anatomy, CaseFacts, Landmark, Side, SurfaceOrigin, Verdict
from pipeline.stages.package import STAGE, Params
from tests.files.lut_sample import content

T = TypeVar("T")

SECRET = "DOE_JANE"
FINDING = Finding("W-FOV-01", Severity.REVIEW, "Only 63 mm of tibia in the scan.")


class Reads:
    """The artifacts of earlier stages, in memory; only what the stage declares."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.values = values

    def __getitem__(self, artifact: Artifact[T]) -> T:
        if artifact not in STAGE.reads:
            raise KeyError(artifact.name)
        value: T = self.values[artifact.name]
        return value


@dataclass
class Out:
    """What the stage leaves."""

    jobs: int = 1
    values: dict[str, Any] = field(default_factory=dict)

    def __setitem__(self, artifact: Artifact[T], value: T) -> None:
        self.values[artifact.name] = value

    def progress(self, done: int, total: int) -> None:
        """Nobody watches."""

    def took(self, part: str, seconds: float) -> None:
        """Nobody asks how long it took."""


def reads(side: Side = "right") -> Reads:
    table = content(side)
    values: dict[str, object] = {a.name: () for a in STAGE.reads if a.name.endswith("_findings")}
    values |= {a.name: {} for a in STAGE.reads if a.name.endswith("_settings")}
    origins = (
        SurfaceOrigin("reference", "femur", "labelled"),
        SurfaceOrigin("reference", "femoral_cartilage", "synthesised"),
        SurfaceOrigin("moving", "tibia", "labelled"),
        SurfaceOrigin("moving", "medial_meniscus", "absent"),
    )
    return Reads(
        {
            **values,
            "intake_findings": (FINDING,),
            "sweep_settings": {"flexion_step_deg": 5.0},
            CASE_FACTS.name: _facts(side),
            MESHES.name: {"femur": table.reference_body, "tibia": table.moving_body},
            ANATOMY.name: _anatomy(table, side),
            REFERENCE_BODY.name: table.reference_body,
            MOVING_BODY.name: table.moving_body,
            MADE_MESHES.name: {},
            SURFACE_ORIGINS.name: origins,
            RAW_TABLE.name: table.raw,
            NEUTRAL_CURVE.name: table.neutral,
            SMOOTH_TABLE.name: table.smooth,
            VERDICT.name: Verdict("REVIEW", ("Only 63 mm of tibia in the scan.",), ()),
            REPORT.name: {"report.html": b"<html></html>", "images/poses.png": b"\x89PNG"},
        }
    )


def _facts(side: Side) -> CaseFacts:
    return CaseFacts(
        case_id="P001",
        joint="knee",
        side=side,
        source="labels",
        source_files={f"{SECRET}.seg.nrrd": "b" * 64, "case.yaml": "a" * 64},
        structures={"femur": 1, "tibia": 2},
        voxels={"femur": 100, "tibia": 100},
        spacing_mm=(1.0, 1.0, 1.0),
        shape=(10, 10, 10),
        clipped_mm2={},
        landmarks={},
    )


def _anatomy(table: LutFileContent, side: Side) -> Anatomy:
    return Anatomy(
        side=side,
        landmarks=(Landmark("lateral_epicondyle", (150.0, -80.0, 650.0), 3.0, "found"),),
        axes=(),
        scan_from_reference=tuple(map(tuple, table.scan_from_reference.tolist())),
        scan_from_moving=tuple(map(tuple, table.scan_from_moving.tolist())),
        delta=tuple(table.delta.tolist()),
        scan_attitude=tuple(table.scan_attitude.tolist()),
        side_evidence=(),
    )


def package(side: Side = "right") -> dict[str, bytes]:
    out = Out()
    assert STAGE.run(reads(side), Params(), out) == ()
    files: dict[str, bytes] = out.values[PACKAGE.name]
    return files


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    return package()


def test_the_deliverable_is_complete(files: dict[str, bytes]) -> None:
    assert set(files) == {
        "README.txt",
        "P001_ct2lut.zip",
        "images/poses.png",
        "knee.glb",
        "lut.csv",
        "lut.h5",
        "lut.json",
        "lut.schema.json",
        "manifest.json",
        "meshes/femur.ply",
        "meshes/femur.stl",
        "meshes/tibia.ply",
        "meshes/tibia.stl",
        "opensim/Geometry/femur.stl",
        "opensim/Geometry/tibia.stl",
        "opensim/joint.osim",
        "report.html",
        "slicer/landmarks.mrk.json",
        "slicer/tibia_flexion_0_varus_0.tfm",
        "slicer/tibia_flexion_30_varus_0.tfm",
        "slicer/tibia_flexion_60_varus_0.tfm",
    }


def test_the_manifest_names_every_file_by_its_hash(files: dict[str, bytes]) -> None:
    manifest = json.loads(files["manifest.json"])
    assert set(manifest["files"]) == set(files) - {"manifest.json", "P001_ct2lut.zip"}
    for name, entry in manifest["files"].items():
        assert entry == {"sha256": hashlib.sha256(files[name]).hexdigest(), "bytes": len(files[name])}
    assert manifest["verdict"] == {"word": "REVIEW", "reasons": ["Only 63 mm of tibia in the scan."]}
    assert manifest["settings"]["sweep"] == {"flexion_step_deg": 5.0}
    assert set(manifest["settings"]) == {"intake", "segment", "mesh", "anatomy", "contact", "sweep", "smooth", "qa"}
    assert manifest["findings"] == [
        {"stage": "intake", "code": "W-FOV-01", "severity": "review", "message": "Only 63 mm of tibia in the scan."}
    ]
    assert (manifest["case_id"], manifest["joint"], manifest["side"]) == ("P001", "knee", "right")
    assert manifest["notice"] == "research use, not for diagnosis"


def test_what_the_moving_bone_carries_goes_with_it_in_every_format() -> None:
    given = reads()
    meshes = given.values[MESHES.name]
    given.values[MESHES.name] = {**meshes, "fibula": meshes["tibia"]}
    given.values["qa_settings"] = {"pictures": {"carried": ["fibula", "no_such_bone"]}}
    out = Out()
    STAGE.run(given, Params(), out)
    files = out.values[PACKAGE.name]
    assert json.loads(files["manifest.json"])["carried"] == ["fibula"]
    assert source_of(files).names("moving") == ("tibia", "fibula")
    assert files["knee.glb"] == export_files(source_of(files), ["glb"])["knee.glb"]
    assert "opensim/Geometry/fibula.stl" in files


def test_no_input_file_name_leaves_with_the_package(files: dict[str, bytes]) -> None:
    assert json.loads(files["manifest.json"])["sources_sha256"] == ["a" * 64, "b" * 64]
    assert not [name for name, data in files.items() if SECRET.encode() in data]


def test_the_archive_is_the_same_package(files: dict[str, bytes]) -> None:
    with zipfile.ZipFile(io.BytesIO(files["P001_ct2lut.zip"])) as archive:
        packed = {name.removeprefix("P001_ct2lut/"): archive.read(name) for name in archive.namelist()}
    assert packed == {name: data for name, data in files.items() if name != "P001_ct2lut.zip"}


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_table_is_that_of_the_stages_before(side: Side) -> None:
    read, expected = decode_lut(package(side)["lut.h5"]), content(side)
    assert (read.side, read.joint) == (side, "knee")
    assert re.fullmatch(r"ct2lut \d+\.\d+\.\d+", read.software)
    np.testing.assert_array_equal(read.smooth.poses.lateral_mm, expected.smooth.poses.lateral_mm)
    np.testing.assert_array_equal(read.raw.margin_lateral_mm, expected.raw.margin_lateral_mm)
    np.testing.assert_array_equal(read.neutral.varus_deg, expected.neutral.varus_deg)
    np.testing.assert_array_equal(read.scan_from_moving, expected.scan_from_moving)
    np.testing.assert_array_equal(read.moving_body.points, expected.moving_body.points)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_package_alone_makes_its_exports_again(side: Side) -> None:
    files = package(side)
    again = export_files(source_of(files))
    assert again == {name: files[name] for name in again}
    assert b"lateral_epicondyle" in again["slicer/landmarks.mrk.json"]


def test_the_readme_names_every_file(files: dict[str, bytes]) -> None:
    text = files["README.txt"].decode()
    tops = {name.partition("/")[0] + ("/" if "/" in name else "") for name in files}
    assert not [top for top in tops - {"README.txt", "P001_ct2lut.zip"} if top not in text]


def test_the_example_of_the_readme_runs(
    files: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lut.h5").write_bytes(files["lut.h5"])
    lines = files["README.txt"].decode().splitlines()
    code = "\n".join(line[4:] for line in lines if line.startswith("    "))
    assert len(code.splitlines()) <= 10
    names: dict[str, Any] = {}
    exec(compile(code, "README.txt", "exec"), names)
    motion = Lut.open("lut.h5").pose(45.0, 0.0)
    points = content().moving_body.points
    np.testing.assert_allclose(names["placed"], points @ motion[:3, :3].T + motion[:3, 3], rtol=0, atol=1e-9)


def test_the_readme_says_whose_and_what(files: dict[str, bytes]) -> None:
    text = files["README.txt"].decode()
    for words in (
        "P001",
        "right knee",
        "not for diagnosis",
        "LPS",
        "moving body (tibia)",
        "(femur, femoral cartilage)",
    ):
        assert words in text
    assert "meniscus" not in text


def test_the_same_case_gives_the_same_bytes(files: dict[str, bytes]) -> None:
    assert package() == files
