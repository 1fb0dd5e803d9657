"""What is installed: every dependency pinned by hash, no registry named, no licence that binds its users."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
LOCKS = ("requirements.lock", "requirements-dev.lock")
#: Offered under several licences, of which we take this one.
CHOSEN = {"pyphen": "License :: OSI Approved :: Mozilla Public License 1.1 (MPL 1.1)"}
PIN = re.compile(r"^(?P<name>[a-z0-9-]+)==(?P<version>[^ ]+)(?: ; (?P<marker>[^\\]+))? \\$", re.MULTILINE)


def pins(lock: str) -> list[tuple[str, str, str]]:
    return [(pin["name"], pin["version"], pin["marker"] or "") for pin in PIN.finditer((CHECKOUT / lock).read_text())]


@pytest.mark.parametrize("lock", LOCKS)
def test_every_line_is_a_pin_or_a_hash(lock: str) -> None:
    lines = (CHECKOUT / lock).read_text().splitlines()
    assert all(PIN.match(line) or re.fullmatch(r"    --hash=sha256:[0-9a-f]{64}( \\)?", line) for line in lines)


@pytest.mark.parametrize("lock", LOCKS)
def test_every_declared_dependency_is_locked(lock: str) -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
    declared = [*project["project"]["dependencies"], *project["dependency-groups"]["build"]]
    if lock == "requirements-dev.lock":
        declared += project["project"]["optional-dependencies"]["dev"]
    names = {re.split(r"[<>=]", requirement)[0].lower() for requirement in declared}
    assert names <= {name for name, _, _ in pins(lock)}


def test_developers_run_what_users_run() -> None:
    assert set(pins("requirements.lock")) <= set(pins("requirements-dev.lock"))


def licence(name: str) -> str:
    """What a distribution says of its licence: the expression, the classifiers, or the first line of the text."""
    described = metadata.metadata(name).json
    classifiers = [text for text in described.get("classifier", []) if text.startswith("License ::")]
    text = str(described.get("license", "")).partition("\n")[0]
    return "; ".join(filter(None, [str(described.get("license_expression", "")), *classifiers, text]))


@pytest.mark.parametrize("name", sorted({name for name, _, marker in pins("requirements.lock") if "==" not in marker}))
def test_no_runtime_licence_binds_users(name: str) -> None:
    try:
        found = licence(name)
    except metadata.PackageNotFoundError:
        pytest.skip(f"{name} is not installed for this Python and platform")
    assert found, "no licence given"
    if name in CHOSEN:
        assert CHOSEN[name] in found.split("; ")
        return
    assert not re.search(r"\bA?GPL|Affero|(?<!Lesser )General Public", found), found
