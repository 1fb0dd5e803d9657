"""The bill of materials and the licence list of an installation."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from tools.inventory import Part, bill, licence_list, python_parts, stated_licences, write

PURL = re.compile(r"pkg:(pypi|deb/debian)/[A-Za-z0-9.%-]+@[A-Za-z0-9.%~_-]+(\?arch=[a-z0-9]+)?")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("inventory") / "new"
    write(place)
    return place


@pytest.fixture(scope="module")
def document(folder: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((folder / "sbom.json").read_text())
    return read


def test_the_bill_is_about_the_program(document: dict[str, Any]) -> None:
    assert (document["bomFormat"], document["specVersion"], document["version"]) == ("CycloneDX", "1.5", 1)
    subject = document["metadata"]["component"]
    assert (subject["name"], subject["version"]) == ("ct2lut", metadata.version("ct2lut"))
    assert "ct2lut" not in [component["name"] for component in document["components"]]


def test_every_part_has_an_address_of_its_own_and_a_licence(document: dict[str, Any]) -> None:
    parts = [document["metadata"]["component"], *document["components"]]
    urls = [part["purl"] for part in parts]
    assert [url for url in urls if not PURL.fullmatch(url)] == []
    assert len(set(urls)) == len(urls)
    assert [part["bom-ref"] for part in parts] == urls
    said = [licence.get("expression") or licence["license"]["name"] for part in parts for licence in part["licenses"]]
    assert len(said) == len(parts)
    assert all(said)


def test_versions_are_those_that_are_imported(document: dict[str, Any]) -> None:
    versions = {part["name"].lower(): part["version"] for part in document["components"]}
    for name in ("numpy", "vtk", "h5py"):
        assert versions[name] == metadata.version(name)


def test_the_texts_of_licences_are_there(folder: Path) -> None:
    paragraphs = (folder / "licences.txt").read_text().strip().split("\n\n")
    named = [Path(line) for paragraph in paragraphs for line in paragraph.splitlines()[1:]]
    assert len(named) > 50
    assert [path for path in named if not path.is_file()] == []


def test_the_same_installation_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    """Also from another process, where sets have another order."""
    program = Path(sys.modules[Part.__module__].__file__ or "")
    subprocess.run([sys.executable, "-I", str(program), str(tmp_path)], check=True, timeout=60)
    for name in ("sbom.json", "licences.txt"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_an_expression_is_given_as_one_and_a_name_as_a_name() -> None:
    program = Part("pkg:pypi/ct2lut@1", "ct2lut", "1", "Apache-2.0", True, ())
    other = Part("pkg:pypi/x@2", "x", "2", "BSD License", False, ("/x/LICENSE",))
    document = bill([program, other])
    assert document["metadata"]["component"]["licenses"] == [{"expression": "Apache-2.0"}]
    assert document["components"][0]["licenses"] == [{"license": {"name": "BSD License"}}]
    assert licence_list([program, other]) == "ct2lut 1: Apache-2.0\n\nx 2: BSD License\n/x/LICENSE\n"


def distribution(folder: Path, name: str, *lines: str, text: str = "") -> None:
    """One that is installed below a folder of packages, with lines about its licence and a text that it brings."""
    place = folder / f"{name}-1.0.dist-info"
    place.mkdir(parents=True)
    (place / "METADATA").write_text("\n".join(("Metadata-Version: 2.4", f"Name: {name}", "Version: 1.0", *lines, "")))
    (place / "RECORD").write_text(f"{place.name}/METADATA,,\n{place.name}/LICENSE,,\n{place.name}/gone/LICENSE,,\n")
    if text:
        (place / "LICENSE").write_text(text)


def test_packages_of_another_environment_are_listed_beside_those_of_this_one(tmp_path: Path) -> None:
    distribution(tmp_path / "a", "engine", "License: MIT")
    distribution(tmp_path / "b", "engine", "License: MIT")
    parts = {part.purl: part for part in python_parts([str(tmp_path / "a"), str(tmp_path / "b")])}
    assert {"pkg:pypi/engine@1.0", f"pkg:pypi/numpy@{metadata.version('numpy')}"} <= set(parts)
    assert [part.purl for part in python_parts([str(tmp_path / "a"), str(tmp_path / "b")])] == sorted(parts)


@pytest.mark.parametrize(
    ("lines", "text", "stated"),
    [
        (["License-Expression: MIT", "License: as it says\n  below"], "GNU", ("MIT", "as it says")),
        (["Classifier: License :: OSI Approved :: BSD License", "License: BSD"], "", ("BSD License", "BSD")),
        (["Classifier: License :: A", "Classifier: License :: B :: C"], "", ("A; C",)),
        ([], "\n  MIT License \n\nCopyright", ("MIT License",)),
        ([], "", ()),
    ],
)
def test_what_a_distribution_says_of_its_licence(
    tmp_path: Path, lines: list[str], text: str, stated: tuple[str, ...]
) -> None:
    distribution(tmp_path, "any", *lines, text=text)
    (found,) = metadata.distributions(path=[str(tmp_path)])
    assert stated_licences(found) == stated
    part = next(part for part in python_parts([str(tmp_path)]) if part.name == "any")
    assert part.licence == (stated[0] if stated else "not stated")
    assert part.is_expression == (lines[:1] == ["License-Expression: MIT"])
    assert [Path(path).name for path in part.texts] == (["LICENSE"] if text else [])
