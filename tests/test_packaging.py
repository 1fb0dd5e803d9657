"""What is installed: every dependency pinned by hash, no registry named, no licence that binds its users."""

from __future__ import annotations

import re
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from tools.inventory import stated_licences

CHECKOUT = Path(__file__).resolve().parents[1]
#: Each with the name of its environment.
LOCKS = {"requirements.lock": ".venv", "requirements-dev.lock": ".venv", "requirements-cohort.lock": ".venv-cohort"}
#: Offered under several licences, of which we take these.
CHOSEN = {
    "pyphen": ("Mozilla Public License 1.1 (MPL 1.1)",),
    # each for a part of it: the GPL is for a mode of Emacs alone, which the wheel does not hold (see below)
    "docutils": ("Public Domain", "BSD License"),
}
BINDING = re.compile(r"\bA?GPL|Affero|(?<!Lesser )General Public", re.IGNORECASE)
PIN = re.compile(r"^(?P<name>[a-z0-9-]+)==(?P<version>[^ ]+)(?: ; (?P<marker>[^\\]+))? \\$", re.MULTILINE)


def pins(lock: str) -> list[tuple[str, str, str]]:
    return [(pin["name"], pin["version"], pin["marker"] or "") for pin in PIN.finditer((CHECKOUT / lock).read_text())]


@pytest.mark.parametrize("lock", LOCKS)
def test_every_line_is_a_pin_or_a_hash(lock: str) -> None:
    lines = (CHECKOUT / lock).read_text().splitlines()
    assert all(PIN.match(line) or re.fullmatch(r"    --hash=sha256:[0-9a-f]{64}( \\)?", line) for line in lines)


def declared(lock: str) -> list[str]:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
    groups: dict[str, list[str]] = project["dependency-groups"]
    if lock == "requirements-cohort.lock":
        return groups["cohort"]
    more = project["project"]["optional-dependencies"]["dev"] if lock == "requirements-dev.lock" else []
    return [*project["project"]["dependencies"], *groups["build"], *more]


@pytest.mark.parametrize("lock", LOCKS)
def test_every_declared_dependency_is_locked(lock: str) -> None:
    names = {re.split(r"[<>=]", requirement)[0].lower() for requirement in declared(lock)}
    assert names
    assert names <= {name for name, _, _ in pins(lock)}


def test_developers_run_what_users_run() -> None:
    assert set(pins("requirements.lock")) <= set(pins("requirements-dev.lock"))


def installed(environment: str) -> dict[str, metadata.Distribution]:
    """What an environment beside the tests holds, by the name that a lock gives it; empty where there is none."""
    own = Path(sys.prefix) if environment == ".venv" else CHECKOUT / environment
    folders = [str(path) for path in own.glob("lib/python3.*/site-packages")]
    found = metadata.distributions(path=folders)
    return {re.sub(r"[-_.]+", "-", one.metadata["Name"]).lower(): one for one in found}


@pytest.mark.parametrize(
    ("environment", "name"),
    sorted(
        {
            (LOCKS[lock], name)
            for lock in ("requirements.lock", "requirements-cohort.lock")
            for name, _, marker in pins(lock)
            if "==" not in marker
        }
    ),
)
def test_no_runtime_licence_binds_users(environment: str, name: str) -> None:
    found = installed(environment).get(name)
    if found is None:
        pytest.skip(
            f"{name} is not in {environment}: it is not for this Python and platform, or type make setup-cohort"
        )
    stated = stated_licences(found)
    assert stated, "no licence given"
    if name in CHOSEN:
        assert set(CHOSEN[name]) <= {one for text in stated for one in text.split("; ")}
        return
    assert not BINDING.search("; ".join(stated)), stated


def test_what_is_gpl_in_docutils_is_not_installed() -> None:
    docutils = installed(".venv-cohort").get("docutils")
    if docutils is None:
        pytest.skip("the engine is not installed (make setup-cohort)")
    said = docutils.read_text("licenses/COPYING.rst") or ""
    parts = [part for part in said.split("\n* ") if re.search(r"released under the `GNU\s", part)]
    assert [part.split()[0] for part in parts if "relicensed" not in part] == ["tools/editors/emacs/rst.el"]
    assert [path for path in docutils.files or () if path.suffix == ".el"] == []
