"""What is documented is what the program does: commands, settings, message codes, make targets, links."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tools.reference import pages

CHECKOUT = Path(__file__).resolve().parents[1]
PAGES = pages()
LINK = re.compile(r"\[[^]]*\]\((?!https?:|mailto:|#)([^)#\s]+)[^)]*\)")
TEXTS = sorted([*CHECKOUT.glob("*.md"), *(CHECKOUT / "docs").glob("**/*.md"), *(CHECKOUT / "pipeline").glob("*.md")])


@pytest.mark.parametrize("name", PAGES)
def test_reference_pages_are_what_the_code_says(name: str) -> None:
    assert (CHECKOUT / "docs" / name).read_text() == PAGES[name], "run `make docs` and read what changed"


def test_every_code_has_a_wording() -> None:
    rows = [line for line in PAGES["messages.md"].splitlines() if re.match(r"\| [ENW]-", line)]
    assert rows
    assert not [row for row in rows if row.rstrip("| ").endswith("-" + row[2:].split()[0].split("-")[-1])]


@pytest.mark.parametrize("text", TEXTS, ids=[str(path.relative_to(CHECKOUT)) for path in TEXTS])
def test_links_lead_somewhere(text: Path) -> None:
    missing = [link for link in LINK.findall(text.read_text()) if not (text.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("text", TEXTS, ids=[str(path.relative_to(CHECKOUT)) for path in TEXTS])
def test_make_targets_in_texts_exist(text: Path) -> None:
    targets = set(re.findall(r"^([a-z][a-z-]*):", (CHECKOUT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"`make ([a-z][a-z-]*)", text.read_text())) <= targets
