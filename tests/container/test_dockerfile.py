"""What can be said of the Dockerfile without building it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from pipeline import __version__

CHECKOUT = Path(__file__).resolve().parents[2]
TEXT = (CHECKOUT / "Dockerfile").read_text()
#: One instruction a line, without comments.
LINES = re.sub(r"\\\n\s*", "", re.sub(r"^#.*\n", "", TEXT, flags=re.MULTILINE)).splitlines()


def instructions(name: str) -> list[str]:
    return [line.partition(" ")[2] for line in LINES if line.startswith(f"{name} ")]


def test_what_is_copied_is_there_and_nothing_else_is_sent() -> None:
    """Cases and results beside the checkout never reach the engine that builds."""
    ignore = (CHECKOUT / ".dockerignore").read_text().split()
    sources = [word for line in instructions("COPY") if "--from=" not in line for word in line.split()[:-1]]
    assert ignore[0] == "*"
    assert sorted(sources) == sorted(line[1:] for line in ignore if line.startswith("!"))
    assert [name for name in sources if not (CHECKOUT / name).exists()] == []


def test_both_stages_begin_with_the_base_that_is_named_once() -> None:
    assert instructions("FROM") == ["${BASE} AS build", "${BASE}"]
    assert [line for line in instructions("ARG") if "debian" in line] == ["BASE=debian:bookworm-slim"]


def test_it_ends_as_nobody_with_a_health_check() -> None:
    user, group = instructions("USER")[-1].split(":")
    assert int(user) > 0
    assert int(group) > 0
    assert instructions("HEALTHCHECK")
    last = [line.partition(" ")[0] for line in LINES if line][-5:]
    assert last == ["USER", "WORKDIR", "HEALTHCHECK", "ENTRYPOINT", "CMD"]


def test_the_label_says_the_version() -> None:
    assert f'org.opencontainers.image.version="{__version__}"' in instructions("LABEL")[0]


def test_the_label_says_the_licence() -> None:
    licence = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]["license"]
    assert f'org.opencontainers.image.licenses="{licence}"' in instructions("LABEL")[0]


def test_only_hashes_decide_what_python_installs() -> None:
    installed = [step for line in instructions("RUN") for step in line.split("&&") if "pip install" in step]
    assert len(installed) == 3
    assert "--require-hashes --requirement requirements.lock" in installed[0]
    assert "--require-hashes --requirement requirements-cohort.lock" in installed[1]
    assert "--no-deps --no-build-isolation" in installed[2]
