"""Test objects as case folders: what is written is what the joint file says."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest

from pipeline.case_declaration import read_declaration
from pipeline.config import CONFIGS, joints
from pipeline.files.meshes import read_mesh
from pipeline.files.strict_yaml import parse_yaml
from pipeline.files.validation_case import ValidationKind, validation_pair, write_validation_case

KINDS: tuple[ValidationKind, ...] = ("ball_dish", "bar_pyramids")


def joint(kind: str) -> dict[str, dict[str, object]]:
    return cast("dict[str, dict[str, object]]", parse_yaml((CONFIGS / "joints" / f"{kind}.yaml").read_bytes()))


@pytest.mark.parametrize("kind", KINDS)
def test_written_meshes_are_those_of_the_pair(tmp_path: Path, kind: ValidationKind) -> None:
    write_validation_case(tmp_path / "case", kind)
    pair = validation_pair(kind)
    for structure, mesh in {**pair.reference, **pair.moving}.items():
        read = read_mesh((tmp_path / f"case/meshes/{structure}.ply").read_bytes(), f"meshes/{structure}.ply")
        np.testing.assert_array_equal(read.mesh.points, mesh.points)
        np.testing.assert_array_equal(read.mesh.triangles, mesh.triangles)
        assert read.findings == ()


@pytest.mark.parametrize("kind", KINDS)
def test_case_names_its_joint(tmp_path: Path, kind: ValidationKind) -> None:
    write_validation_case(tmp_path, kind)
    declared = read_declaration(tmp_path)
    assert (declared.side, declared.joint) == ("right", kind)
    assert kind in joints()


@pytest.mark.parametrize("kind", KINDS)
def test_joint_file_agrees_with_the_objects(kind: ValidationKind) -> None:
    pair, settings = validation_pair(kind), joint(kind)
    anatomy, contact = settings["anatomy"], settings["contact"]
    np.testing.assert_allclose(np.asarray(anatomy["scan_from_reference"]), pair.scan_from_reference, atol=1e-15)
    np.testing.assert_allclose(np.asarray(anatomy["scan_from_moving"]), pair.scan_from_moving, atol=1e-15)
    assert (contact["reference"], contact["moving"]) == (list(pair.reference), list(pair.moving))
    assert settings["intake"]["required"] == [*pair.reference, *pair.moving]


@pytest.mark.parametrize("kind", KINDS)
def test_same_bytes_every_time(tmp_path: Path, kind: ValidationKind) -> None:
    for name in ("one", "two"):
        write_validation_case(tmp_path / name, kind)
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file())
    assert len(files) >= 3
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_unknown_object() -> None:
    with pytest.raises(ValueError, match="ball_dish or bar_pyramids, got 'cup'"):
        validation_pair(cast("ValidationKind", "cup"))
