"""A phantom on disk is the phantom in memory, declared as a user would declare it."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import ConfigError
from pipeline.files.nrrd_format import read_nrrd
from pipeline.files.phantom_case import write_phantom_case
from pipeline.files.strict_yaml import parse_yaml
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec

SPEC = PhantomSpec(side="left", spacing_mm=(3.0, 3.0, 3.0), placement_deg=(10.0, 20.0, 30.0), shaft_length_mm=5.0)


def test_the_case_holds_the_phantom_and_its_declaration(tmp_path: Path) -> None:
    write_phantom_case(tmp_path / "cases" / "demo", SPEC)
    case = tmp_path / "cases" / "demo"
    image = read_nrrd((case / "labels.nrrd").read_bytes(), "labels.nrrd")
    volume = phantom_labels(SPEC)
    np.testing.assert_array_equal(image.values, volume.values)
    np.testing.assert_array_equal(image.lps_from_index, volume.lps_from_index)
    declaration = parse_yaml((case / "case.yaml").read_bytes())
    assert declaration == {"side": "left", "joint": "knee", "labels": "phantom"}
    assert sorted(path.name for path in case.parent.rglob("*")) == ["case.yaml", "demo", "labels.nrrd"]


def test_equal_specs_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("first", "second"):
        write_phantom_case(tmp_path / name, SPEC)
    first, second = ((tmp_path / name / "labels.nrrd").read_bytes() for name in ("first", "second"))
    assert first == second


def test_a_case_that_is_there_is_left_alone(tmp_path: Path) -> None:
    case = tmp_path / "P001"
    case.mkdir()
    (case / "labels.nrrd").write_bytes(b"a patient's")
    with pytest.raises(ConfigError, match="E-PHA-01 The case P001 is there already"):
        write_phantom_case(case, SPEC)
    assert (case / "labels.nrrd").read_bytes() == b"a patient's"


def test_the_label_scheme_has_the_phantom_s_values() -> None:
    scheme = files("pipeline").joinpath("configs/labels/phantom.yaml").read_bytes()
    assert parse_yaml(scheme) == PHANTOM_LABELS
