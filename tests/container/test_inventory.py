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

from tools.inventory import Part, bill, licence_list, write

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
