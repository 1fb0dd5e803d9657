from __future__ import annotations

import time
from dataclasses import replace

import pytest

from pipeline.engine.console import console_listener
from pipeline.engine.outcome import StageOutcome
from pipeline.engine.stage import Finding, Severity

RAN = StageOutcome("intake", 10, "ran", "no result yet", 0.31, ())
CACHED = StageOutcome("mesh", 30, "cached", "up to date", 0.02, (Finding("N-X-01", Severity.NOTE, "a note"),))
REVIEW = StageOutcome(
    "anatomy", 40, "cached", "up to date", 0.0, (Finding("W-LMK-02", Severity.REVIEW, "2 mm off\x1b[2J"),)
)
FAILED = StageOutcome("sweep", 60, "failed", "E-ENV-01", 61.04, ())


def shown(outcome: StageOutcome, *, terminal: bool) -> str:
    parts: list[str] = []
    listener = console_listener(parts.append, terminal=terminal)
    listener.stage_finished(outcome, 1, 8)
    return "".join(parts)


@pytest.mark.parametrize("terminal", [False, True])
def test_one_line_a_stage(*, terminal: bool) -> None:
    assert shown(RAN, terminal=terminal) == "[1/8] intake     ok         0.3 s  ran (no result yet)\n"
    assert shown(CACHED, terminal=terminal) == "[1/8] mesh       ok         0.0 s  up to date\n"
    assert shown(FAILED, terminal=terminal) == "[1/8] sweep      failed    61.0 s  E-ENV-01\n"
    interrupted = replace(FAILED, reason="interrupted")
    assert shown(interrupted, terminal=terminal) == "[1/8] sweep      halted    61.0 s  interrupted\n"


def test_a_finding_to_review_is_shown_and_cannot_steer_the_terminal() -> None:
    text = shown(REVIEW, terminal=False)
    assert text == "[1/8] anatomy    review     0.0 s  up to date\n      W-LMK-02 2 mm off\\x1b[2J\n"


def test_plain_output_has_no_progress() -> None:
    parts: list[str] = []
    listener = console_listener(parts.append, terminal=False)
    listener.stage_started("mesh", 2, 8, "code changed")
    listener.stage_progress("mesh", 1, 2)
    assert parts == []


def test_a_terminal_shows_a_bar_that_is_gone_when_the_stage_ends() -> None:
    parts: list[str] = []
    listener = console_listener(parts.append, terminal=True)
    listener.stage_progress("mesh", 1, 2)
    listener.stage_started("mesh", 2, 8, "setting [bold]x 1 -> 2")
    listener.stage_progress("mesh", 1, 2)
    time.sleep(0.15)
    listener.stage_finished(RAN, 2, 8)
    text = "".join(parts)
    assert "setting [bold]x 1 -> 2" in text
    assert text.endswith("ran (no result yet)\n")
    assert "\x1b[2K" in text
