"""The drawing of the flow in pipeline/README.md is the flow."""

from __future__ import annotations

from pathlib import Path

from tools.reference import FLOW_END, FLOW_START, flow_table

README = Path(__file__).resolve().parents[1] / "pipeline" / "README.md"


def test_the_drawn_flow_is_the_flow() -> None:
    text = README.read_text()
    drawn = text[text.index(FLOW_START) + len(FLOW_START) : text.index(FLOW_END)].strip()
    assert drawn == flow_table(), "run `make docs`"
