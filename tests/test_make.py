"""The Makefile: what a user types reaches the program as text and is never run by make or the shell."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]

#: Each tries to make the file SENTINEL by another way through make or the shell.
HOSTILE = (
    "; touch SENTINEL",
    "x; touch SENTINEL #",
    "`touch SENTINEL`",
    "$(touch SENTINEL)",
    "$$(touch SENTINEL)",
    "$(shell touch SENTINEL)",
    "$$(shell touch SENTINEL)",
    "${shell touch SENTINEL}",
    "$(eval X := $(shell touch SENTINEL))",
    "$(file >SENTINEL,x)",
    '" ; touch SENTINEL ; "',
    "' ; touch SENTINEL ; '",
    "x && touch SENTINEL",
    "x | touch SENTINEL",
    "x > SENTINEL",
    "$(error stop)",
    "x\ntouch SENTINEL",
    "--version",
    "*",
)

TARGETS = (
    "help",
    "setup",
    "demo",
    "demo-real",
    "check",
    "patient",
    "plan",
    "cohort",
    "resume",
    "watch",
    "tidy",
    "status",
    "report",
    "verify",
    "review",
    "doctor",
)
DEVELOPER_TARGETS = ("test", "test-cohort", "test-cluster", "scale", "lint", "bench", "validate", "clean")
VARIABLES = ("ID", "CASES", "RESULTS", "PROTOCOL", "SET", "JOBS")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout whose programs only record their arguments, one a line."""
    shutil.copy(CHECKOUT / "Makefile", tmp_path)
    for name in ("tools/setup.sh", ".venv/bin/ct2lut", ".venv/bin/python"):
        program = tmp_path / name
        program.parent.mkdir(parents=True, exist_ok=True)
        program.write_text('#!/bin/sh\nprintf "%s\\n" "${0##*/}" "$@" >> ARGUMENTS\n')
        program.chmod(0o755)
    return tmp_path


def make(checkout: Path, *words: str, environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    clean = {"PATH": os.environ["PATH"], **(environment or {})}
    return subprocess.run(
        ["make", "--no-print-directory", *words],
        cwd=checkout,
        env=clean,
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )


def arguments(checkout: Path) -> list[str]:
    return (checkout / "ARGUMENTS").read_text().split("ct2lut\n", 1)[1].splitlines()


@pytest.mark.fault("I02")
@pytest.mark.parametrize("way", ["command line", "environment", "environment -e"])
@pytest.mark.parametrize("variable", VARIABLES)
def test_nothing_typed_is_run(checkout: Path, variable: str, way: str) -> None:
    for hostile in HOSTILE:
        values = {"ID": "P001", variable: hostile}
        words = [f"{name}={value}" for name, value in values.items()] if way == "command line" else []
        flags = ["-e"] if way.endswith("-e") else []
        make(checkout, *flags, "patient", *words, environment=None if words else values)
        assert not (checkout / "SENTINEL").exists(), hostile


@pytest.mark.fault("I02")
@pytest.mark.parametrize("way", ["command line", "environment"])
@pytest.mark.parametrize("target", ["check", "patient", "plan", "report", "open", "verify", "status"])
@pytest.mark.parametrize("hostile", HOSTILE)
def test_id_arrives_letter_by_letter(checkout: Path, hostile: str, target: str, way: str) -> None:
    words, environment = ((f"ID={hostile}",), None) if way == "command line" else ((), {"ID": hostile})
    make(checkout, target, *words, environment=environment)
    received = arguments(checkout)
    assert "\n".join(received[received.index("--") + 1 :]) == hostile


def test_sub_make_runs_nothing_either(checkout: Path) -> None:
    (checkout / "outer.mk").write_text("all:\n\t$(MAKE) -f Makefile patient\n")
    make(checkout, "-f", "outer.mk", "ID=$$(shell touch SENTINEL)")
    assert not (checkout / "SENTINEL").exists()


@pytest.mark.parametrize("hostile", ["; touch SENTINEL", "$(shell touch SENTINEL)", "`touch SENTINEL`"])
def test_the_sentinel_betrays_a_naive_makefile(checkout: Path, hostile: str) -> None:
    (checkout / "Makefile").write_text("patient:\n\t.venv/bin/ct2lut run $(ID)\n")
    make(checkout, "patient", f"ID={hostile}")
    assert (checkout / "SENTINEL").exists()


def test_settings_become_options(checkout: Path) -> None:
    make(checkout, "patient", "ID=P001", "SET=sweep.step_deg=2  smooth.list=[1,2]", "JOBS=3", "CASES=my cases")
    expected = ["run", "--set", "sweep.step_deg=2", "--set", "smooth.list=[1,2]", "--cases", "my cases"]
    expected += ["--results", "results", "--protocol", "clinical", "--jobs", "3", "--", "P001"]
    assert arguments(checkout) == expected


@pytest.mark.parametrize("hostile", HOSTILE)
def test_a_file_arrives_letter_by_letter(checkout: Path, hostile: str) -> None:
    make(checkout, "review", "ID=P001", f"FILE={hostile}")
    assert "\n".join(arguments(checkout)) == f"review\n--results\nresults\n--\nP001\n{hostile}"
    assert not (checkout / "SENTINEL").exists()


@pytest.mark.parametrize("target", ["check", "plan"])
def test_looking_takes_settings_and_no_number_of_jobs(checkout: Path, target: str) -> None:
    make(checkout, target, "ID=P001", "SET=sweep.step_deg=2", "JOBS=3")
    expected = [target, "--set", "sweep.step_deg=2", "--cases", "cases", "--results", "results"]
    assert arguments(checkout) == [*expected, "--protocol", "clinical", "--", "P001"]


@pytest.mark.parametrize("target", ["check", "patient", "plan", "report", "open"])
def test_missing_id_is_explained(checkout: Path, target: str) -> None:
    answer = make(checkout, target)
    assert answer.returncode == 2
    assert f"Type: make {target} ID=P001" in answer.stderr


@pytest.mark.parametrize("target", ["overview", "doctor", "resume", "verify"])
@pytest.mark.parametrize("hostile", HOSTILE)
def test_a_folder_arrives_letter_by_letter(checkout: Path, hostile: str, target: str) -> None:
    make(checkout, target, f"RESULTS={hostile}")
    assert "\n".join(arguments(checkout)) == f"{target}\n--results\n{hostile}"
    assert not (checkout / "SENTINEL").exists()


@pytest.mark.parametrize("hostile", HOSTILE)
def test_a_profile_arrives_letter_by_letter(checkout: Path, hostile: str) -> None:
    make(checkout, "cohort", f"PROFILE={hostile}")
    assert "\n".join(arguments(checkout)).split("\n--profile\n")[1] == hostile
    assert not (checkout / "SENTINEL").exists()


@pytest.mark.parametrize("target", ["cohort", "watch"])
def test_many_cases_take_settings(checkout: Path, target: str) -> None:
    make(checkout, target, "CASES=my cases", "SET=sweep.step_deg=2", "JOBS=2")
    places = ["--cases", "my cases", "--results", "results", "--protocol", "clinical", "--jobs", "2"]
    assert arguments(checkout)[:11] == [target, "--set", "sweep.step_deg=2", *places]


def test_a_number_of_days_arrives(checkout: Path) -> None:
    make(checkout, "tidy", "DAYS=30")
    assert arguments(checkout) == ["clean", "--results", "results", "--older-than-days", "30"]


def test_status_needs_no_id(checkout: Path) -> None:
    assert make(checkout, "status").returncode == 0
    assert arguments(checkout) == ["status", "--results", "results"]


def test_help_lists_every_documented_target(checkout: Path) -> None:
    shown = make(checkout).stdout
    for target in TARGETS + DEVELOPER_TARGETS:
        assert f"make {target} " in shown
