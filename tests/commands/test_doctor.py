"""The doctor: every check says what it found, fails in one sentence with what to do, and leaves nothing behind."""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from pipeline import __version__
from pipeline.adapters import pdf, rendering, self_test
from pipeline.commands import doctor, doctor_program
from pipeline.commands.doctor import Check, checked, closing, exit_code, json_line, lines
from pipeline.commands.doctor_answer import Answer, State
from pipeline.engine import sandbox
from pipeline.errors import EnvironmentFault, ExitCode

CHECKOUT = Path(__file__).resolve().parents[2]
#: Keys for monitoring: an entry may be added, never renamed.
NAMES = [
    *("python", "packages", "solver", "renderer", "pdf", "sealing", "memory", "processors", "limits", "temporary"),
    *("cohorts", "disk", "results", "locks", "clock"),
]
PROGRAM = "from pipeline.cli import main; main()"
Patch = pytest.MonkeyPatch


def bare(*program: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Our interpreter without a home and without anything else in its environment."""
    environment = {"PATH": os.defpath, "PYTHONPATH": str(CHECKOUT)}
    command = [sys.executable, "-P", *program]
    return subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True, check=False, timeout=300)


def test_this_machine_is_ready_and_nothing_is_left_on_it(tmp_path: Path) -> None:
    done = bare("-c", PROGRAM, "doctor", "--results", "no/results", "--json", cwd=tmp_path)
    told = json.loads(done.stdout)
    assert list(told) == ["ok", "checks", "version"]
    assert [check["name"] for check in told["checks"]] == NAMES
    assert all(list(check) == ["name", "state", "found", "action"] for check in told["checks"])
    assert not [check for check in told["checks"] if check["state"] == "FAIL"]
    assert (told["ok"], told["version"], done.returncode, done.stderr) == (True, __version__, ExitCode.PASS, "")
    found = {check["name"]: check["found"] for check in told["checks"]}
    assert found["renderer"].startswith(f"{rendering.RENDER_WINDOW}, ")
    assert found["results"].startswith("no/results is not there yet; tried in the folder you are in: ")
    assert str(tmp_path) not in done.stdout
    assert str(CHECKOUT) not in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_the_doctor_itself_needs_no_library(tmp_path: Path) -> None:
    """What is not installed is told by a check and must not keep the doctor from coming."""
    program = (
        "import sys, pipeline.commands.doctor; print({'numpy', 'pydantic', 'packaging', 'numba'} & set(sys.modules))"
    )
    assert bare("-c", program, cwd=tmp_path).stdout == "set()\n"


# the program


def test_a_renderer_that_kills_its_process_is_named(monkeypatch: Patch) -> None:
    monkeypatch.setattr(doctor_program, "_TRIAL", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    check = checked("renderer", doctor.PROBES["renderer"])
    assert (check.state, check.found) == (State.FAIL, "pictures cannot be drawn: exit -11 (Segmentation fault)")
    assert check.action == what_a_run_says_of_the_renderer(monkeypatch)


def what_a_run_says_of_the_renderer(monkeypatch: Patch) -> str:
    monkeypatch.setattr(rendering, "_PROBE", "raise SystemExit(1)")
    rendering.require_renderer.cache_clear()
    with pytest.raises(EnvironmentFault, match="cannot draw pictures") as caught:
        rendering.require_renderer()
    return caught.value.action


@pytest.mark.parametrize("name", ["solver", "renderer", "pdf"])
@pytest.mark.parametrize(
    ("child", "found"),
    [
        ("while True: pass", "no end after 1 s"),
        ("raise SystemExit(3)", "exit 3"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "exit -9 (Killed)"),
    ],
)
def test_a_trial_may_end_in_any_way(monkeypatch: Patch, name: str, child: str, found: str) -> None:
    monkeypatch.setattr(doctor_program, "_TRIAL", child)
    monkeypatch.setattr(doctor_program, "TRIAL_SECONDS", 1.0)
    begun = time.monotonic()
    check = checked(name, doctor.PROBES[name])
    assert time.monotonic() - begun < 30
    assert check.state is State.FAIL
    assert check.found.endswith(f": {found}")
    assert check.action


@pytest.mark.parametrize("said", ["", "nonsense", "[]", '{"lost": 1}'])
def test_a_trial_that_says_nonsense_is_a_failure(monkeypatch: Patch, said: str) -> None:
    monkeypatch.setattr(doctor_program, "_TRIAL", f"print({said!r}, end='')")
    check = checked("renderer", doctor.PROBES["renderer"])
    assert check.state is State.FAIL
    assert check.found.startswith("the check itself failed (")


def test_what_libraries_print_does_not_hide_the_answer(monkeypatch: Patch) -> None:
    monkeypatch.setattr(doctor_program, "_TRIAL", f'print("advice", end=""); {doctor_program._TRIAL}')
    assert doctor_program.renderer().state is State.OK


def test_a_trial_does_not_stand_where_the_user_stands(monkeypatch: Patch, tmp_path: Path) -> None:
    """Without a home, libraries leave their caches there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor_program, "_TRIAL", "import json, os; print(json.dumps({'found': os.getcwd()}), end='')")
    assert doctor_program.try_in_child("renderer").found == "/"


def trial(act: Callable[[], str]) -> dict[str, str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(self_test, "TRIALS", {"any": act})
        answered = json.loads(self_test.answer("any"))
    assert isinstance(answered, dict)
    return answered


def raising(error: BaseException) -> Callable[..., Any]:
    def act(*_: object, **__: object) -> Any:
        raise error

    return act


def test_a_trial_answers_whatever_it_meets() -> None:
    assert trial(lambda: "a window") == {"found": "a window"}
    fault = EnvironmentFault("E-ENV-12", "No font.", "Install one.")
    assert trial(raising(fault)) == {"problem": "No font.", "action": "Install one."}
    missing = trial(raising(ModuleNotFoundError("no", name="vtkmodules")))
    assert missing == {"problem": "the Python package vtkmodules is missing", "action": "make setup"}
    broken = trial(raising(ImportError("/secret/lib.so: cannot open")))
    assert broken == {"problem": "it failed with ImportError", "action": ""}


def test_missing_fonts_are_told_in_the_words_of_a_run(monkeypatch: Patch) -> None:
    monkeypatch.setattr(pdf, "_weasyprint", raising(EnvironmentFault("E-ENV-12", "no font", "install")))
    assert trial(self_test.text) == {"problem": "no font", "action": "install"}


def test_a_solver_that_is_not_compiled_is_worth_a_look_and_stays_so(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for _ in range(2):
        answer = doctor_program.solver()
        assert (answer.state, answer.action.rpartition(": ")[2]) == (State.LOOK, "ct2lut compile")
        assert answer.found.startswith("not compiled")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_machine_code_without_a_place_is_a_failure(monkeypatch: Patch) -> None:
    """As on a read-only root, for an installation that was not made for one."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("NUMBA_CACHE_LOCATOR_CLASSES", "UserProvidedCacheLocator")
    answer = doctor_program.solver()
    assert (answer.state, answer.found) == (State.FAIL, "its machine code has no folder that can be written to")
    assert "export NUMBA_CACHE_DIR=" in answer.action


def distributions(monkeypatch: Patch, requires: list[str], **versions: str | None) -> None:
    def version(name: str) -> str | None:
        if name not in versions:
            raise metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(metadata, "requires", lambda _: requires)
    monkeypatch.setattr(metadata, "version", version)


def test_packages_in_their_bounds(monkeypatch: Patch) -> None:
    requires = ["vtk<9.8,>=9.7", "numpy>=2.2", 'mypy; extra == "dev"', 'tomli; python_version < "3.0"']
    distributions(monkeypatch, requires, vtk="9.7.2", numpy="2.10.0rc1")
    assert doctor_program.packages() == Answer("all 2 there, in the expected versions")


def test_wrong_packages_are_all_named(monkeypatch: Patch) -> None:
    distributions(
        monkeypatch, ["vtk<9.8,>=9.7", "numpy>=2.2", "scipy>=1", "rich>=15"], vtk="9.10", rich="15", scipy=None
    )
    answer = doctor_program.packages()
    assert answer.found == "3 of 4: vtk 9.10, expected <9.8,>=9.7; numpy is missing; scipy None, expected >=1"
    assert (answer.state, answer.action.endswith("make setup")) == (State.FAIL, True)


@pytest.mark.parametrize(
    ("name", "module"), [("packages", "packaging.requirements"), ("sealing", "pipeline.engine.confinement")]
)
def test_a_package_that_the_doctor_needs_may_be_missing(monkeypatch: Patch, name: str, module: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    check = checked(name, doctor.PROBES[name])
    assert (check.state, check.found) == (State.FAIL, f"a Python package cannot be used: {module}")
    assert check.action.endswith("make setup")


def test_a_program_that_is_not_installed(monkeypatch: Patch) -> None:
    monkeypatch.setattr(metadata, "metadata", raising(metadata.PackageNotFoundError("ct2lut")))
    assert checked("python", doctor.PROBES["python"]).found == "a Python package cannot be used: ct2lut"


def test_an_old_python_is_named(monkeypatch: Patch) -> None:
    monkeypatch.setattr(platform, "python_version", lambda: "3.10.2")
    answer = doctor_program.interpreter()
    assert (answer.state, answer.found) == (State.FAIL, "CPython 3.10.2 (expected >=3.11)")
    assert "make setup PYTHON=" in answer.action


def test_the_seal_is_the_one_of_a_run(monkeypatch: Patch) -> None:
    for part, taken in (("_filter_calls", "seccomp"), ("_restrict_folders", "Landlock")):
        with monkeypatch.context() as patch:
            patch.setattr(sandbox, "_filter_calls", lambda _: True)
            patch.setattr(sandbox, "_restrict_folders", lambda *_: True)
            assert doctor_program.sealing().state is State.OK
            patch.setattr(sandbox, part, lambda *_: False)
            answer = doctor_program.sealing()
        assert (answer.state, answer.found) == (State.LOOK, f"only partly: {taken} cannot be used here")


def test_a_sealed_child_that_dies_is_a_failure(monkeypatch: Patch) -> None:
    monkeypatch.setattr(sandbox, "_limit", lambda _: os.kill(os.getpid(), signal.SIGKILL))
    answer = doctor_program.sealing()
    assert (answer.state, answer.found) == (State.FAIL, "a sealed process cannot work here: no file could be read")


# what is said


def test_further_checks_are_told_before_those_of_the_folder(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(doctor, "PROBES", {"python": lambda: Answer("there")})
    checks = list(doctor.examine(tmp_path, {"cohorts": raising(ImportError("no", name="yaml"))}))
    assert [check.name for check in checks] == ["python", *NAMES[NAMES.index("cohorts") :]]
    assert (checks[1].state, checks[1].found) == (State.FAIL, "a Python package cannot be used: yaml")


def test_a_check_that_crashes_is_a_failed_check() -> None:
    check = checked("any", raising(ValueError("/secret/place")))
    assert check == Check("any", State.FAIL, "the check itself failed (ValueError)", "Please report this line.")


OK, LOOK, FAIL = (Check(state.value, state, "found", "" if state is State.OK else "Do it.") for state in State)


def test_a_line_a_check_and_what_to_do_below() -> None:
    assert lines(OK) == ["ok          ok    found"]
    assert lines(LOOK) == ["LOOK        LOOK  found", "                  -> Do it."]
    assert lines(Check("x", State.OK, "a\nb\x1b", "")) == ["x           ok    a\\nb\\x1b"]


@pytest.mark.parametrize(
    ("checks", "last", "code"),
    [
        ([OK], "This machine is ready.", ExitCode.PASS),
        ([OK, LOOK], "This machine is ready; look at LOOK.", ExitCode.PASS),
        ([OK, FAIL, LOOK], "This machine is not ready: mend FAIL.", ExitCode.ENVIRONMENT),
    ],
)
def test_what_it_comes_to(checks: list[Check], last: str, code: ExitCode) -> None:
    assert (closing(checks), exit_code(checks)) == (last, code)
    assert json.loads(json_line(checks))["ok"] == (code == ExitCode.PASS)
    assert "\n" not in json_line(checks)
