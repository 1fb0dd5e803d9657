"""What an installation consists of and under which licences: ``python inventory.py FOLDER [MORE ...]`` writes it there.

MORE are folders of packages of other environments, such as that of the workflow engine.

``sbom.json`` is a CycloneDX 1.5 bill of materials, ``licences.txt`` says the same to people. The Dockerfile runs it
with the image's own Python, so it needs the standard library alone. The same installation gives the same bytes.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import quote

PROGRAM = "ct2lut"
UNKNOWN = "not stated"
LICENCE_NAMES = ("licen", "copying", "notice", "copyright")
LICENCE_SUFFIXES = ("", ".txt", ".md", ".rst")
DPKG_FIELDS = "${binary:Package}\t${Version}\t${Architecture}\n"


@dataclass(frozen=True, order=True)
class Part:
    """One thing that is installed.

    Parameters
    ----------
    purl : str
        Package URL, unique; the order.
    name, version : str
        As its own world names them.
    licence : str
        What it says of its licence itself.
    is_expression : bool
        Whether that is an SPDX expression.
    texts : tuple of str
        Files with the full texts.
    """

    purl: str
    name: str
    version: str
    licence: str
    is_expression: bool
    texts: tuple[str, ...]


def python_parts(more: Sequence[str] = ()) -> list[Part]:
    """Every distribution that this Python finds, or that lies in other folders of packages; each once, sorted."""
    places = (sys.path, *([folder] for folder in more))
    found = {_python_part(one) for path in places for one in metadata.distributions(path=path)}
    return sorted({part.purl: part for part in sorted(found, reverse=True)}.values())


def debian_parts() -> list[Part]:
    """Every installed Debian package, sorted; none on another system."""
    if shutil.which("dpkg-query") is None:
        return []
    command = ["dpkg-query", "--show", f"--showformat={DPKG_FIELDS}"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout  # noqa: S603 - no foreign word
    return sorted(_debian_part(*line.split("\t")) for line in listed.splitlines())


def bill(parts: list[Part]) -> dict[str, Any]:
    """The CycloneDX 1.5 document of an installation.

    Parameters
    ----------
    parts : list of Part
        What is installed; the program itself becomes the subject of the bill.
    """
    program = next(part for part in parts if part.name == PROGRAM)
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": _component(program, "application")},
        "components": [_component(part, "library") for part in parts if part is not program],
    }


def licence_list(parts: list[Part]) -> str:
    """One paragraph a part: name, version, licence, and where its texts lie."""
    paragraphs = ("\n".join((f"{part.name} {part.version}: {part.licence}", *part.texts)) for part in parts)
    return "\n\n".join(paragraphs) + "\n"


def write(folder: Path, more: Sequence[str] = ()) -> None:
    """Write ``sbom.json`` and ``licences.txt`` of this installation into a folder, which is made."""
    parts = python_parts(more) + debian_parts()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sbom.json").write_text(json.dumps(bill(parts), indent=1) + "\n", encoding="utf-8")
    (folder / "licences.txt").write_text(licence_list(parts), encoding="utf-8")


def stated_licences(found: metadata.Distribution) -> tuple[str, ...]:
    """All that a distribution says of its licence, each way of saying it once, the most exact first.

    An SPDX expression, its classifiers in one, the first line of its licence field; where it says nothing so, the first
    line of the texts that it brings.
    """
    described = found.metadata.json
    kinds = [text.rpartition(" :: ")[2] for text in described.get("classifier", []) if text.startswith("License :: ")]
    expression, field = (str(described.get(key, "")) for key in ("license_expression", "license"))
    told = [expression, "; ".join(kinds), _first_line(field)]
    return tuple(filter(None, told if any(told) else map(_first_line, map(_read, _texts(found)))))


def _python_part(found: metadata.Distribution) -> Part:
    described = found.metadata.json
    name, version, texts = str(described["name"]), found.version, tuple(map(str, _texts(found)))
    purl = f"pkg:pypi/{name.lower().replace('_', '-')}@{quote(version)}"
    licence = next(iter(stated_licences(found)), UNKNOWN)
    return Part(purl, name, version, licence, "license_expression" in described, texts)


def _texts(found: metadata.Distribution) -> list[Path]:
    named = {Path(str(found.locate_file(path))) for path in found.files or () if _is_licence_text(path)}
    return sorted(path for path in named if path.is_file())


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0].strip()


def _is_licence_text(path: PurePath) -> bool:
    return path.suffix in LICENCE_SUFFIXES and any(word in path.name.lower() for word in LICENCE_NAMES)


def _debian_part(name: str, version: str, architecture: str) -> Part:
    plain = name.partition(":")[0]
    text = f"/usr/share/doc/{plain}/copyright"
    purl = f"pkg:deb/debian/{quote(plain)}@{quote(version)}?arch={architecture}"
    return Part(purl, plain, version, f"see {text}", False, (text,) if Path(text).is_file() else ())


def _component(part: Part, kind: str) -> dict[str, Any]:
    licence = {"expression": part.licence} if part.is_expression else {"license": {"name": part.licence}}
    return {
        "type": kind,
        "bom-ref": part.purl,
        "name": part.name,
        "version": part.version,
        "purl": part.purl,
        "licenses": [licence],
    }


if __name__ == "__main__":
    write(Path(sys.argv[1]), sys.argv[2:])
