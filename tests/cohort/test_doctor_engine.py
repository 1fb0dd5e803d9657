"""What the doctor says of the workflow engine: which one, that it answers, and what to type where it does not."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

import pipeline
from pipeline.cohort import doctor_engine
from pipeline.cohort.doctor_engine import engine_answer
from pipeline.cohort.driver import PROGRAM_VARIABLE, find_engine
from pipeline.commands.doctor_answer import Answer, State

Patch = pytest.MonkeyPatch


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: Patch) -> Path:
    """A checkout, an environment and a PATH without an engine."""
    monkeypatch.setattr(pipeline, "__file__", str(tmp_path / "checkout" / "pipeline" / "__init__.py"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "opt" / "tables"))
    monkeypatch.setenv("PATH", f"{tmp_path}/usr/bin{os.pathsep}/bin")
    monkeypatch.delenv(PROGRAM_VARIABLE, raising=False)
    return tmp_path


def engine(environment: Path, script: str) -> Path:
    """A program in place of the engine."""
    program = environment / "bin" / "snakemake"
    program.parent.mkdir(parents=True)
    program.write_text(script)
    program.chmod(0o755)
    return program


def test_without_an_engine_a_single_case_is_well(machine: Path) -> None:
    assert engine_answer() == Answer("not installed; a single case does not need it (make setup-cohort)")


@pytest.mark.parametrize(
    ("environment", "place"),
    [("checkout/.venv-cohort", ".venv-cohort"), ("opt/tables-cohort", "tables-cohort"), ("usr", "your own")],
)
def test_the_engine_is_found_where_a_cohort_finds_it(machine: Path, environment: str, place: str) -> None:
    program = engine(machine / environment, '#!/bin/sh\n[ "$*" = --version ] && echo 9.27.1\n')
    assert engine_answer() == Answer(f"snakemake 9.27.1 ({place})")
    assert find_engine("workstation", 0).snakemake == program


def test_the_one_that_is_named_comes_first(machine: Path, monkeypatch: Patch) -> None:
    engine(machine / "checkout" / ".venv-cohort", "#!/bin/sh\necho 9.27.1\n")
    other = engine(machine / "other", "#!/bin/sh\necho 9.30.0\n")
    monkeypatch.setenv(PROGRAM_VARIABLE, str(other))
    assert engine_answer() == Answer("snakemake 9.30.0 (your own)")


def test_a_name_without_a_program_is_worth_a_look(machine: Path, monkeypatch: Patch) -> None:
    engine(machine / "checkout" / ".venv-cohort", "#!/bin/sh\necho 9.27.1\n")
    monkeypatch.setenv(PROGRAM_VARIABLE, "no/where")
    answer = engine_answer()
    assert (answer.state, answer.found) == (State.LOOK, f'{PROGRAM_VARIABLE} names no program: "no/where".')
    assert f"export {PROGRAM_VARIABLE}=FILE" in answer.action


@pytest.mark.parametrize(
    ("script", "how"),
    [
        ("#!/bin/sh\nexit 3\n", "exit 3"),
        ("#!/bin/sh\nkill -SEGV $$\n", "exit -11"),
        ("#!/no/python\n", "it cannot be started (FileNotFoundError)"),
        ("#!/bin/sh\nexec sleep 60\n", "no answer after 1 s"),
        ("#!/bin/sh\necho a word\n", "a word"),
    ],
)
def test_one_that_does_not_work_is_worth_a_look(machine: Path, monkeypatch: Patch, script: str, how: str) -> None:
    engine(machine / "checkout" / ".venv-cohort", script)
    monkeypatch.setattr(doctor_engine, "ANSWER_S", 1.0)
    begun = time.monotonic()
    answer = engine_answer()
    assert time.monotonic() - begun < 30
    assert (answer.state, answer.found) == (
        State.LOOK,
        f"snakemake (.venv-cohort) is there and does not work: {how}",
    )
    assert "make setup-cohort" in answer.action
    assert str(machine) not in answer.found + answer.action


def test_it_leaves_no_cache_where_the_user_stands(machine: Path, monkeypatch: Patch) -> None:
    script = '#!/bin/sh\ntouch cache "$HOME/cache" "$XDG_CACHE_HOME/cache" && echo 9.27.1\n'
    engine(machine / "checkout" / ".venv-cohort", script)
    home = machine / "home"
    home.mkdir()
    monkeypatch.chdir(home)
    monkeypatch.setenv("HOME", str(home))
    assert engine_answer().state is State.OK
    assert list(home.iterdir()) == []


def test_the_engine_itself_says_its_version() -> None:
    if PROGRAM_VARIABLE in os.environ or not (Path(pipeline.__file__).parents[1] / ".venv-cohort").is_dir():
        pytest.skip("the engine is not installed (make setup-cohort)")
    answer = engine_answer()
    assert answer.state is State.OK
    assert answer.found.startswith("snakemake 9.")
    assert answer.found.endswith(" (.venv-cohort)")
